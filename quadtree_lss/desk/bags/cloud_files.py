# SPDX-License-Identifier: Apache-2.0
"""Point clouds in files, with or without a file of poses, read like a bag."""

from __future__ import annotations

import re
from decimal import Decimal
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.desk.bags.bag import FORMATS, PACKED, Bag, BagError, MessageBag, Topic
from quadtree_lss.desk.bags.message_types import POSE_TYPE, SCAN_TYPE, typestore
from quadtree_lss.desk.bags.topics import POSE_TOPIC, SCAN_TOPIC
from quadtree_lss.desk.exchange.clouds import READERS, PoseTable, read_clouds, read_poses
from quadtree_lss.desk.exchange.libraries import ExchangeError
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.errors import one_line
from quadtree_lss.onboard.messages.maps import record_dtype
from quadtree_lss.onboard.messages.outputs import MessageMaker

#: Without poses: assumed height of the lidar above the ground, m, and attitude error, rad.
ABOVE, ATTITUDE_SIGMA = 2000.0, 1e-6
LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])
SECOND_NS = 10**9
UNITS_NS = (1, 10**3, 10**6, 10**9)
ROUNDED_NS = 1000
"""Rounding of a stamp in seconds."""
OURS = ("truth.npz", "cells.npz", "grid.npz", "history.npz")
"""Files of a simulation or of results, which are not clouds."""
NO_POSES = "no --poses: the clouds are taken to be in the map's frame, seen from above"


def open_recording(
    path: str | Path | Bag, poses: str | Path | None = None, frame: str = "map"
) -> Bag:
    """Open a bag or point clouds (a file or a folder). ``poses``: file of poses for clouds in the
    lidar's axes; None for clouds in the map frame, which ``frame`` names. Raises `BagError`: there
    is nothing to read, or poses are given for a bag."""
    if isinstance(path, Bag):
        return path
    place = Path(path)
    if _is_clouds(place):
        try:
            return _bag_of(place, None if poses is None else Path(poses), frame)
        except ExchangeError as error:
            raise BagError(str(error)) from None
    if poses is not None and place.exists():
        msg = f"--poses goes with point clouds ({' '.join(READERS)}), of which there are none here"
        raise BagError(f"{place}: {msg}")
    return Bag(place)


def _is_clouds(path: Path) -> bool:
    """True for a cloud and for a folder of clouds without a bag."""
    if path.is_dir():
        names = {p.suffix.lower() for p in path.iterdir() if p.name not in OURS}
        return not names & {*FORMATS, *PACKED} and bool(names & {*READERS})
    return path.is_file() and path.suffix.lower() in READERS


def _bag_of(path: Path, poses_path: Path | None, frame: str) -> MessageBag:
    """The clouds of a file or folder on ``/lidar/points`` and their poses on ``/nav/pose``; each
    message is made when it is read."""
    files = [path]
    if path.is_dir():
        there = (p for p in path.iterdir() if p.name not in OURS and p != poses_path)
        files = [p for p in there if p.suffix.lower() in READERS]
        files.sort(key=lambda p: ([*map(int, re.findall(r"\d+", p.stem)), 0], p.name))
    table = None if poses_path is None else read_poses(poses_path)
    read = lru_cache(maxsize=1)(read_clouds)
    found: list[tuple[Path, int, Any]] = []  # file, which of its clouds, its stamp if it has one
    corners: list[Array] = []
    losses: list[str] = []
    for file in files:
        try:
            clouds, own = read(file)
        except ExchangeError as error:
            losses.append(one_line(error))
            continue
        found += [(file, k, None if own is None else own[k]) for k in range(len(clouds))]
        corners += [_corners(cloud) for cloud in clouds]
    if not found:
        raise BagError("; ".join(losses) or f"{path}: there is no point cloud")
    stamps = [stamp for _, _, stamp in found]
    if None in stamps:
        stamps = _stamps(path, [file for file, *_ in found], table)
    scans = sorted((int(t), str(file), k) for t, (file, k, _) in zip(stamps, found, strict=True))
    note = ""
    if table is None:
        low, high = np.nanmin(corners, axis=(0, 1)), np.nanmax(corners, axis=(0, 1))
        eye = np.round(np.append(0.5 * (low + high)[:2], high[2] + ABOVE))
        covariance = np.diag(np.repeat([0.01, ATTITUDE_SIGMA], 3) ** 2).reshape(36)
        rows = (eye, (1.0, 0.0, 0.0, 0.0), covariance)
        times = np.array([stamp for stamp, *_ in scans], np.int64)
        table = PoseTable(times, *(np.tile(row, (len(scans), 1)) for row in rows))
        note = NO_POSES
    types = typestore(ros1=False).types
    of_lidar, of_map = (MessageMaker(types, np.asarray, name) for name in ("lidar", frame))

    def cloud(stamp: int, file: str, k: int) -> Any:
        points = read(Path(file))[0][k]
        if poses_path is None:
            points = (points - eye) @ LOOKING_DOWN
        kind = "f4" if points.dtype == np.float32 else "f8"
        fields = record_dtype((kind, "xyz"))
        records = np.ascontiguousarray(points, fields["x"]).view(fields)[..., 0]
        return of_lidar.cloud(records, stamp)

    def pose(k: int) -> Any:
        of = table.position[k], table.xyzw[k], table.covariance[k]
        return of_map.pose(int(table.stamp_ns[k]), *of)

    messages = [(POSE_TOPIC, int(t), partial(pose, k)) for k, t in enumerate(table.stamp_ns)]
    messages += [(SCAN_TOPIC, scan[0], partial(cloud, *scan)) for scan in scans]
    messages.sort(key=lambda message: message[1])
    topics = [Topic(SCAN_TOPIC, SCAN_TYPE, len(scans))]
    topics.append(Topic(POSE_TOPIC, POSE_TYPE, len(table.stamp_ns)))
    span_ns = messages[0][1], messages[-1][1]
    return MessageBag(str(path), topics, span_ns, messages, losses, filter(None, [note]))


def _stamps(path: Path, files: list[Path], table: PoseTable | None) -> list[int]:
    """From the names if these are times within the poses', else by the poses' order."""
    if table is None:
        return [(k + 1) * SECOND_NS // 10 for k in range(len(files))]
    known, same = table.stamp_ns, len(files) == len(table.stamp_ns)
    texts = [re.findall(r"\d+(?:\.\d+)?", file.stem)[-1:] for file in files]
    numbers = {Decimal(text[0]) for text in texts if text}
    units = UNITS_NS if len(numbers) == len(files) else ()
    tries = [[round(Decimal(text[0]) * unit) for text in texts] for unit in units]
    inside = [sum(known[0] <= t <= known[-1] for t in times) for times in tries]
    fit = [t for t, n in zip(tries, inside, strict=True) if n == max(inside) > 0.5 * len(files)]
    # From 0 s on, small numbers are within the poses in any unit, and may be no times at all.
    if len(fit) == 1 or fit and not same:
        return [_near(known, t) for t in fit[-1]]
    if same:
        return known.tolist()
    msg = f"{path}: which pose belongs to which cloud? The names hold no times between those of the"
    msg += f" poses ({1e-9 * known[0]:.3f} ... {1e-9 * known[-1]:.3f} s), and"
    raise BagError(f"{msg} {len(files)} clouds are not {len(known)} poses")


def _near(known: NDArray[np.int64], stamp: int) -> int:
    """The stamp of a pose that is the same but for rounding, else the stamp itself."""
    near = known[np.searchsorted(known, stamp - ROUNDED_NS) :][:1].tolist()
    return near[0] if near and near[0] <= stamp + ROUNDED_NS else stamp


def _corners(points: NDArray[Any]) -> Array:
    """(2, 3) least and greatest coordinates; NaN without a return."""
    flat = points.reshape(-1, 3)
    sound = flat[np.isfinite(flat).all(axis=1)]
    sound = sound if len(sound) else np.full((1, 3), np.nan)
    return np.array([sound.min(axis=0), sound.max(axis=0)], np.float64)
