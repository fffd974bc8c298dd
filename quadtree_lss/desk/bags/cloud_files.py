# SPDX-License-Identifier: Apache-2.0
"""Point clouds in files, with a file of poses or none, as the messages that a bag would hold."""

from __future__ import annotations

import heapq
import re
from collections.abc import Collection, Iterator
from decimal import Decimal
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.desk.bags.bag import Bag, BagError, Topic, likely_bag
from quadtree_lss.desk.bags.message_types import POSE_TYPE, SCAN_TYPE, typestore
from quadtree_lss.desk.bags.recorded_file import LAST_NS, RawMessage
from quadtree_lss.desk.bags.topics import POSE_TOPIC, SCAN_TOPIC
from quadtree_lss.desk.exchange.clouds import READERS, read_clouds
from quadtree_lss.desk.exchange.poses import read_poses
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.elevation.libraries import ExchangeError
from quadtree_lss.onboard.errors import one_line
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.maps import record_dtype
from quadtree_lss.onboard.messages.outputs import MessageMaker

#: Without poses: from so far above its ground a cloud is seen, m; its attitude is known, rad.
ABOVE, ATTITUDE_SIGMA = 2000.0, 1e-6
LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])
SECOND_NS = 10**9
_UNITS_NS = (1, 10**3, 10**6, 10**9)


def open_recording(path: str | Path, poses: str | Path | None = None, frame: str = "map") -> Bag:
    """A bag, or point clouds: a file or a folder of them. ``path``: of the bag or the clouds.
    ``poses``: file of poses for clouds in the lidar's axes; None for clouds in the map frame.
    ``frame``: name of the map frame, of clouds. Raises `BagError`: there is nothing to read, or a
    bag is given poses that it has itself."""
    place = Path(path)
    if is_clouds(place):
        return CloudFiles(place, None if poses is None else Path(poses), frame)
    if poses is not None and place.exists():
        kinds = " ".join(READERS)
        msg = f"{place}: --poses goes with point clouds ({kinds}), of which there are none here"
        raise BagError(msg)
    return Bag(place)


def is_clouds(path: Path) -> bool:
    """Whether it is a cloud, or a folder of clouds without a bag."""
    if path.is_dir():
        names = [p.suffix.lower() for p in path.iterdir()]
        bag = {".mcap", ".db3", ".bag", ".zst", ".zstd"} & set(names)
        # A folder with a bag in it and the truth beside that, as `simulate` leaves it, is none.
        return not bag and any(name in READERS for name in names) and not likely_bag(path)
    return path.is_file() and path.suffix.lower() in READERS


class CloudFiles(Bag):
    """The clouds of a file or folder and their poses (`open_recording`), on ``/lidar/points`` and
    ``/nav/pose``; what stands for the bytes of a message is its number."""

    def __init__(self, path: Path, poses: Path | None, frame: str) -> None:
        super().__init__(path)
        self._poses_path = poses
        types = typestore(ros1=False, wanted=(SCAN_TYPE, POSE_TYPE)).types
        self._of_lidar = MessageMaker(types, np.asarray, "lidar")
        self._of_map = MessageMaker(types, np.asarray, frame)
        self._read = lru_cache(maxsize=1)(read_clouds)
        self._stack.callback(self._read.cache_clear)

    def messages(
        self, topics: Collection[str], start_ns: int = 0, stop_ns: int = LAST_NS
    ) -> Iterator[RawMessage]:
        kinds = {POSE_TOPIC: self._pose_stamps, SCAN_TOPIC: [stamp for stamp, *_ in self._scans]}
        streams = [
            [RawMessage(name, stamp, str(k).encode()) for k, stamp in enumerate(stamps)]
            for name, stamps in kinds.items()
            if name in topics
        ]
        for message in heapq.merge(*streams, key=lambda message: message.received_ns):
            if start_ns <= message.received_ns < stop_ns:
                yield message

    def decode(self, raw: bytes, msgtype: str) -> Any:
        make = self._cloud_message if msgtype == SCAN_TYPE else self._pose_message
        try:
            return make(int(raw))
        except ExchangeError as error:
            raise MessageError("encoding", str(error)) from None

    def _open(self) -> None:
        try:
            self._find()
        except ExchangeError as error:
            raise BagError(str(error)) from None
        scans, poses = len(self._scans), len(self._pose_stamps)
        self.topics = [Topic(SCAN_TOPIC, SCAN_TYPE, scans), Topic(POSE_TOPIC, POSE_TYPE, poses)]
        stamps = [*self._pose_stamps, *(stamp for stamp, *_ in self._scans)]
        self.start_ns, self.end_ns = min(stamps), max(stamps)

    def _find(self) -> None:
        files = [self.path]
        if self.path.is_dir():
            files = [p for p in self.path.iterdir() if p.suffix.lower() in READERS]
            files.sort(key=lambda p: [int(n) for n in re.findall(r"\d+", p.stem)] + [0])
            files = [p for p in files if p != self._poses_path]
        self._poses = None if self._poses_path is None else read_poses(self._poses_path)
        found = []  # file, which of its clouds, its stamp if it has one
        corners: list[Array] = []
        for file in files:
            try:
                clouds, stamps = self._read(file)
            except ExchangeError as error:
                self._losses.append(one_line(error))
                continue
            found += [(file, k, None if stamps is None else stamps[k]) for k in range(len(clouds))]
            corners += [_corners(cloud) for cloud in clouds]
        if not found:
            raise BagError("; ".join(self._losses) or f"{self.path}: there is no point cloud")
        stamps_ns = [stamp for _, _, stamp in found if stamp is not None]
        if len(stamps_ns) < len(found):
            stamps_ns = self._stamps([file for file, *_ in found])
        rows = zip(stamps_ns, found, strict=True)
        self._scans = sorted((int(t), str(file), k) for t, (file, k, _) in rows)
        self._pose_stamps = [stamp for stamp, *_ in self._scans]
        if self._poses is not None:
            self._pose_stamps = self._poses.stamp_ns.tolist()
        else:
            low, high = np.nanmin(corners, axis=(0, 1)), np.nanmax(corners, axis=(0, 1))
            self._eye = np.round(np.append(0.5 * (low + high)[:2], high[2] + ABOVE))
            self.notes.append(
                "no --poses: the clouds are taken to be in the map's frame, seen from above"
            )

    def _stamps(self, files: list[Path]) -> list[int]:
        """From the names if these are times within the poses', else by the poses' order."""
        if self._poses is None:
            return [(k + 1) * SECOND_NS // 10 for k in range(len(files))]
        known = self._poses.stamp_ns
        numbers = [_number(file.stem) for file in files]
        if None not in numbers and len(set(numbers)) == len(files):
            tries = [[round(n * unit) for n in numbers if n is not None] for unit in _UNITS_NS]
            inside = [sum(known[0] <= t <= known[-1] for t in times) for times in tries]
            if max(inside) > 0.5 * len(files):
                return tries[inside.index(max(inside))]
        if len(files) == len(known):
            return known.tolist()
        span = " ... ".join(f"{1e-9 * t:.3f}" for t in (known[0], known[-1]))
        raise BagError(
            f"{self.path}: which pose belongs to which cloud? The names hold no times between those"
            f" of the poses ({span} s), and {len(files)} clouds are not {len(known)} poses"
        )

    def _cloud_message(self, number: int) -> Any:
        stamp, file, k = self._scans[number]
        points = self._read(Path(file))[0][k]
        if self._poses is None:
            points = (points - self._eye) @ LOOKING_DOWN
        kind = "f4" if points.dtype == np.float32 else "f8"
        fields = record_dtype((kind, "xyz"))
        records = np.ascontiguousarray(points, fields["x"]).view(fields)[..., 0]
        return self._of_lidar.cloud(records, stamp)

    def _pose_message(self, number: int) -> Any:
        stamp, table = self._pose_stamps[number], self._poses
        if table is not None:
            of = table.position[number], table.xyzw[number], table.covariance[number]
            return self._of_map.pose(stamp, *of)
        covariance = np.diag(np.repeat([0.01, ATTITUDE_SIGMA], 3) ** 2).reshape(36)
        return self._of_map.pose(stamp, self._eye, (1.0, 0.0, 0.0, 0.0), covariance)


def _corners(points: NDArray[Any]) -> Array:
    """(2, 3) least and greatest coordinates; NaN without a return."""
    flat = points.reshape(-1, 3)
    sound = flat[np.isfinite(flat).all(axis=1)]
    if not len(sound):
        return np.full((2, 3), np.nan)
    return np.array([sound.min(axis=0), sound.max(axis=0)], np.float64)


def _number(stem: str) -> Decimal | None:
    """The last number of a name, exactly."""
    found = re.findall(r"\d+(?:\.\d+)?", stem)
    return Decimal(found[-1]) if found else None
