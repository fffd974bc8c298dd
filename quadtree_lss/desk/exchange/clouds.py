# SPDX-License-Identifier: Apache-2.0
"""Point clouds in files: NPY, NPZ, PLY, PCD, LAS and LAZ."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.elevation.archives import read_arrays
from quadtree_lss.onboard.elevation.libraries import ExchangeError, library

Array = NDArray[Any]
Clouds = tuple[list[Array], NDArray[np.int64] | None]

MOST_POINTS = 1 << 20
"""Of one scan; larger clouds, as surveys are, become several."""


def read_clouds(path: Path) -> Clouds:
    """The clouds of a file, and their stamps in ns if it has any.

    Each is (N, 3), or (H, W, 3) if the file says that it is organised; m, NaN for no return.

    Raises:
        ExchangeError: the file cannot be read, or the library for it is missing.
    """
    try:
        clouds, stamps = READERS[path.suffix.lower()](path)
    except ExchangeError:
        raise
    except Exception as error:  # any content must do, and each library has errors of its own
        line = (str(error) or type(error).__name__).splitlines()[0]
        msg = f"{path}: not a readable {path.suffix.lower()} file: {line}"
        raise ExchangeError(msg) from None
    if stamps is None:
        clouds = [part for cloud in clouds for part in _parts(cloud)]
    return clouds, stamps


def _parts(cloud: Array) -> list[Array]:
    if cloud.size // 3 <= MOST_POINTS:
        return [cloud]
    flat = cloud.reshape(-1, 3)
    return [flat[k : k + MOST_POINTS] for k in range(0, len(flat), MOST_POINTS)]


def _npy(path: Path) -> Clouds:
    return [_coordinates(path, np.load(path, allow_pickle=False))], None


def _npz(path: Path) -> Clouds:
    """``points`` of one scan, or with one more axis of several and ``stamp_ns`` of each."""
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
    # What is in it decides what this makes of it; vertices they all have.
    loaded = trimesh.load(path, process=False, force=None)
    return [_coordinates(path, np.asarray(loaded.vertices, np.float64))], None


def _pcd(path: Path) -> Clouds:
    cloud = library("pypcd4", "PCD files").PointCloud.from_path(path)
    points = np.asarray(cloud.numpy(("x", "y", "z")), np.float64)
    height, width = cloud.metadata.height, cloud.metadata.width
    if height > 1:
        points = points.reshape(height, width, 3)
    return [_coordinates(path, points)], None


def _las(path: Path) -> Clouds:
    laspy = library("laspy", "LAS and LAZ files")
    if path.suffix.lower() == ".laz":
        library("lazrs", "LAZ files")
    with laspy.open(path) as reader:
        chunks = [
            np.column_stack([np.asarray(axis, np.float64) for axis in (c.x, c.y, c.z)])
            for c in reader.chunk_iterator(MOST_POINTS)
        ]
    return chunks or [np.zeros((0, 3))], None


def _coordinates(path: Path, array: Array) -> Array:
    """The first three columns are x, y, z."""
    if array.ndim not in (2, 3) or array.shape[-1] < 3 or array.dtype.kind not in "fiu":
        msg = f"{path}: {array.dtype} {array.shape} is not a point cloud, (N, 3) or (H, W, 3)"
        raise ExchangeError(msg)
    wanted = array[..., :3]
    return np.asarray(wanted, np.float32 if array.dtype == np.float32 else np.float64)


READERS: dict[str, Callable[[Path], Clouds]] = {
    ".npy": _npy,
    ".npz": _npz,
    ".ply": _ply,
    ".pcd": _pcd,
    ".las": _las,
    ".laz": _las,
}
"""By the end of a file's name."""
