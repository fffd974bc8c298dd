# SPDX-License-Identifier: Apache-2.0
"""Decoding of rectified depth images into points in the camera's optical frame.

The optical axes (z ahead, x right, y down) are the lidar axes. A pixel (u, v) of depth z is the
point (x z, y z, z) with x = (u - cx) / fx, y = (v - cy) / fy.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quadtree_lss.onboard.arrays import Array, Mask, Points
from quadtree_lss.onboard.config.sections import LidarConfig
from quadtree_lss.onboard.messages.clouds import MAX_POINTS, MessageError, bytes_of

ENCODINGS = {"16UC1": ("u2", 1e-3), "mono16": ("u2", 1e-3), "32FC1": ("f4", 1.0)}
"""NumPy type code of a pixel, and its unit in m."""
EDGE_WIDTHS = 4.0
"""Maximum depth difference of neighbouring pixels on one surface, pixel widths: ground at a grazing
angle of 14 degrees."""
EDGE_SIGMAS = 4.0
"""Part of that limit due to the noise, standard deviations."""
COLUMNS = 320
"""Number of image columns used, evenly spaced; rows have the same spacing. Errors of neighbouring
stereo pixels are correlated, so a quarter of 640 x 480 has nearly all information."""
MIN_FOCAL_LENGTH, MAX_INTRINSIC = 1.0, 1e7
"""Smallest focal length; largest focal length and position of the optical axis, px."""


class DepthCamera:
    """Converts depth images to points with the noise model of ``lidar``. ``edges``: pixels
    dropped from the last image because they lie between a near and a far surface."""

    def __init__(self, lidar: LidarConfig) -> None:
        self._lidar, self.edges = lidar, 0
        self._info: Any = None
        self._rays: Array | None = None  # (H, W, 2) float32: x / z and y / z of the used pixels
        self._key: tuple[object, ...] = ()

    def on_info(self, info: Any) -> None:
        """Use a ``CameraInfo``. Raises `MessageError` with reason ``focal_length`` if it does not
        describe a pinhole camera."""
        k, p = (np.array(matrix, dtype=np.float64) for matrix in (info.k, info.p))
        f = p[[0, 5, 2, 6]] if p[0] > 0.0 else k[[0, 4, 2, 5]]
        if not ((np.abs(f) <= MAX_INTRINSIC).all() and (f[:2] >= MIN_FOCAL_LENGTH).all()):
            text = f"camera_info has no focal length or axis of a camera: {f.tolist()} px"
            raise MessageError("focal_length", text)
        key = (*f.tolist(), int(info.width), int(info.height))
        if key != self._key:
            self._key, self._info = key, f
            self._shape, self._rays = (int(info.height), int(info.width)), None

    def points(self, image: Any) -> Points:
        """Return points (H, W, 3) float32 of every n-th pixel (see `COLUMNS`), m; NaN means no
        return. Raises `MessageError` with reason ``camera_info``, ``encoding`` or ``size``."""
        if self._info is None:
            raise MessageError("camera_info", "a depth image came before any depth/camera_info")
        height, width = int(image.height), int(image.width)
        if image.encoding not in ENCODINGS:
            text = f"depth image of encoding '{image.encoding}'; supported: {', '.join(ENCODINGS)}"
            raise MessageError("encoding", text)
        kind, unit = ENCODINGS[image.encoding]
        data, size = bytes_of(image.data), int(kind[1])
        plausible = 0 < height * width <= MAX_POINTS and image.step >= width * size
        if not plausible or data.size < (height - 1) * image.step + width * size:
            text = f"depth image of {width} x {height} {image.encoding} has {data.size} bytes"
            raise MessageError("size", text + f", {image.step} a row")
        if (height, width) != self._shape:
            text = f"depth image of {width} x {height}, camera_info of {self._shape[1]} x"
            raise MessageError("size", f"{text} {self._shape[0]}")
        order = ">" if image.is_bigendian else "<"
        whole = np.ndarray((height, width), order + kind, data, 0, (image.step, size))
        step, f = max(round(width / COLUMNS), 1), self._info
        if self._rays is None:
            u, v = np.arange(step // 2, width, step), np.arange(step // 2, height, step)
            rays = np.meshgrid((u - f[2]) / f[0], (v - f[3]) / f[1])
            self._rays = np.stack(rays, axis=-1).astype(np.float32)
        z = np.asarray(whole[step // 2 :: step, step // 2 :: step], dtype=np.float32)
        with np.errstate(invalid="ignore", over="ignore"):  # depths are not checked yet
            z = z * np.float32(unit)
            z[~((z > 0.0) & (z < np.inf))] = np.nan
            limit = EDGE_WIDTHS * z / np.float32(f[0])
            limit += EDGE_SIGMAS * (self._lidar.range_noise + self._lidar.stereo_noise * z * z)
            edges = np.zeros(z.shape, dtype=np.bool_)
            rows, columns = whole[:, step // 2 :: step], whole[step // 2 :: step].T
            _mark_edges(rows, z, limit, edges, step, np.float32(unit))
            _mark_edges(columns, z.T, limit.T, edges.T, step, np.float32(unit))
        self.edges = int(np.count_nonzero(edges))
        z[edges] = np.nan
        points = np.empty((*z.shape, 3), dtype=np.float32)
        with np.errstate(over="ignore"):
            np.multiply(self._rays, z[..., None], out=points[..., :2])
        points[..., 2] = z
        return points


def _mark_edges(
    lines: Points, z: Points, limit: Points, edges: Mask, step: int, unit: np.float32
) -> None:
    """Mark pixels whose depth differs by more than ``limit`` from both neighbours along axis 0 and
    lies between them. ``lines``: all rows of the image in ``unit``, of which ``z`` has every
    ``step``-th, m. Pixels without two neighbours with a return are not marked."""
    first, count = step // 2, len(lines)
    inner = slice(int(first == 0), (count - 2 - first) // step + 1)
    begin, end = first + step * inner.start, first + step * (inner.stop - 1) + 1
    before = lines[begin - 1 : end - 1 : step] * unit
    after = lines[begin + 1 : end + 1 : step] * unit
    down, up, most = z[inner] - before, after - z[inner], limit[inner]
    between = ((down > most) & (up > most)) | ((down < -most) & (up < -most))
    edges[inner] |= (before > 0.0) & (after > 0.0) & between
