# SPDX-License-Identifier: Apache-2.0
"""Point clouds in NPY, NPZ, PLY and PCD files, and poses in TUM or CSV files."""

from __future__ import annotations

import re
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.desk.exchange.archives import read_arrays
from quadtree_lss.desk.exchange.libraries import ExchangeError, library

Array = NDArray[Any]
Clouds = tuple[list[Array], NDArray[np.int64] | None]

MOST_POINTS = 1 << 20
"""Points of one scan; larger clouds, such as surveys, become several scans."""


def read_clouds(path: Path) -> Clouds:
    """Read clouds (N, 3), or (H, W, 3) if organised, m, NaN for no return, and their stamps in ns,
    if any. Raises `ExchangeError`: the file cannot be read, or a library is missing."""
    try:
        clouds, stamps = READERS[path.suffix.lower()](path)
    except ExchangeError:
        raise
    except Exception as error:  # each library has errors of its own
        line = (str(error) or type(error).__name__).splitlines()[0]
        msg = f"{path}: not a readable {path.suffix.lower()} file: {line}"
        raise ExchangeError(msg) from None
    if stamps is None:
        whole, clouds = clouds, []
        for cloud in whole:
            flat = cloud.reshape(-1, 3)
            parts = [flat[k : k + MOST_POINTS] for k in range(0, len(flat), MOST_POINTS)]
            clouds += parts if len(parts) > 1 else [cloud]
    return clouds, stamps


def _npz(path: Path) -> Clouds:
    """Read ``points`` of one scan, or with one more axis of several with a ``stamp_ns`` each."""
    arrays = read_arrays(path)
    if "points" not in arrays:
        msg = f"{path}: has no array 'points', but {', '.join(arrays) or 'nothing'}"
        raise ExchangeError(msg)
    points, stamps = arrays["points"], arrays.get("stamp_ns")
    if stamps is None or stamps.ndim == 0:
        one = None if stamps is None else stamps.reshape(1).astype(np.int64)
        return [_coordinates(path, points)], one
    if points.ndim < 3 or stamps.shape != points.shape[:1]:
        msg = f"{path}: points {points.shape} do not go with stamp_ns {stamps.shape}"
        raise ExchangeError(msg)
    return [_coordinates(path, cloud) for cloud in points], stamps.astype(np.int64)


def _ply(path: Path) -> Clouds:
    trimesh = library("trimesh", "PLY files")
    # The content decides the type, but each type has vertices.
    loaded = trimesh.load(path, process=False, force=None)
    return [_coordinates(path, np.asarray(loaded.vertices, np.float64))], None


def _pcd(path: Path) -> Clouds:
    cloud = library("pypcd4", "PCD files").PointCloud.from_path(path)
    points = np.asarray(cloud.numpy(("x", "y", "z")), np.float64)
    height, width = cloud.metadata.height, cloud.metadata.width
    if height > 1:
        points = points.reshape(height, width, 3)
    return [_coordinates(path, points)], None


def _coordinates(path: Path, array: Array) -> Array:
    """Take the first three columns: x, y, z."""
    if array.ndim not in (2, 3) or array.shape[-1] < 3 or array.dtype.kind not in "fiu":
        msg = f"{path}: {array.dtype} {array.shape} is not a point cloud, (N, 3) or (H, W, 3)"
        raise ExchangeError(msg)
    wanted = array[..., :3]
    return np.asarray(wanted, np.float32 if array.dtype == np.float32 else np.float64)


READERS: dict[str, Callable[[Path], Clouds]] = {
    ".npy": lambda path: ([_coordinates(path, np.load(path, allow_pickle=False))], None),
    ".npz": _npz,
    ".ply": _ply,
    ".pcd": _pcd,
}
"""By the end of a file's name."""
TUM = ("stamp", "x", "y", "z", "qx", "qy", "qz", "qw")
COVARIANCE = tuple(f"cov_{k}" for k in range(36))


class PoseTable(NamedTuple):
    """Poses (K,) of the lidar in the map frame by stamp: positions m, quaternions (K, 4) from lidar
    to map axes, covariances (K, 36) of x, y, z and rotations about map axes, 0 if unknown."""

    stamp_ns: NDArray[np.int64]
    position: NDArray[np.float64]
    xyzw: NDArray[np.float64]
    covariance: NDArray[np.float64]


def read_poses(path: Path) -> PoseTable:
    """Read poses. TUM: lines ``stamp x y z qx qy qz qw`` in s and m, ``#`` begins a comment. CSV: a
    header with ``stamp_ns`` (or ``stamp`` in s), the other names of TUM in any order, and perhaps
    ``cov_0`` … ``cov_35``. Raises `ExchangeError`: the file cannot be read, or is neither."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        msg = f"{path}: cannot be read: {getattr(error, 'strerror', None) or 'it is not text'}"
        raise ExchangeError(msg) from None
    lines = [line.partition("#")[0].replace(",", " ").split() for line in text.splitlines()]
    rows = [row for row in lines if row]
    header = list(TUM)
    if rows and not re.match(r"[-+]?\.?\d", rows[0][0]):
        header = rows.pop(0)
    clock = "stamp_ns" if "stamp_ns" in header else "stamp"
    lack = [name for name in (clock, *TUM[1:]) if name not in header]
    if lack or not rows:
        why = f"lacks {', '.join(lack)}" if lack else "there is no pose in it"
        raise ExchangeError(f"{path}: {why}: poses are lines of TUM ({' '.join(TUM)}) or CSV")
    covariances = [name for name in COVARIANCE if name in header]
    unit = 1 if clock == "stamp_ns" else 10**9
    found: list[tuple[int, list[float]]] = []
    for number, row in enumerate(rows, start=1):
        cells = dict(zip(header, row, strict=False))
        try:
            values = [float(cells[name]) for name in (*TUM[1:], *covariances)]
            found.append((int(Decimal(cells[clock]) * unit), values))
        except (ValueError, KeyError, ArithmeticError):
            msg = f"{path}: pose {number} is not a row of numbers: {' '.join(row)[:80]}"
            raise ExchangeError(msg) from None
    found.sort(key=lambda pose: pose[0])
    table = np.array([values for _, values in found])
    known = len(covariances) == len(COVARIANCE)
    covariance = table[:, 7:] if known else np.zeros((len(table), 36))
    stamps = np.array([stamp for stamp, _ in found], np.int64)
    return PoseTable(stamps, table[:, :3], table[:, 3:7], covariance)
