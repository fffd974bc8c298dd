# SPDX-License-Identifier: Apache-2.0
"""Depth images as they arrive, to arrays of points in the camera's optical frame.

Those axes (z ahead, x right, y down) are those of a lidar here. A pixel (u, v) of depth z is the
point (x z, y z, z) with x = (u - cx) / fx, y = (v - cy) / fy: images are rectified.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quadtree_lss.onboard.arrays import Array, Points
from quadtree_lss.onboard.config.sections import LidarConfig
from quadtree_lss.onboard.messages.clouds import MAX_POINTS, MessageError, bytes_of

ENCODINGS = {"16UC1": ("u2", 1e-3), "mono16": ("u2", 1e-3), "32FC1": ("f4", 1.0)}
"""NumPy's word for a pixel, and its unit in m."""
STEEP = 4.0
"""Greatest depth difference of neighbouring pixels on one surface, pixel widths: ground at a
grazing angle of 14 degrees."""
COLUMNS = 320
"""Columns that are used, evenly spaced, with rows at the same spacing: errors of neighbouring
stereo pixels are correlated, so a quarter of 640 x 480 has nearly all information."""
JUMP = 4.0
"""The same in standard deviations of the noise, which is added."""
SHORTEST, FARTHEST = 1.0, 1e7
"""Smallest focal length, and greatest focal length and position of the axis, px."""


class DepthCamera:
    """Turns depth images into points.

    Args:
        lidar: Of which the noise matters.

    Attributes:
        edges: Pixels of the last image that were dropped because they lie between a near and a far
            surface.
    """

    def __init__(self, lidar: LidarConfig) -> None:
        self._lidar, self.edges = lidar, 0
        self._info: Any = None
        self._rays: Array | None = None
        self._key: tuple[object, ...] = ()

    def on_info(self, info: Any) -> None:
        """Use a ``CameraInfo``. Raises `MessageError`: ``focal_length``, not a pinhole camera."""
        k, p = (np.array(given, dtype=np.float64) for given in (info.k, info.p))
        f = p[[0, 5, 2, 6]] if p[0] > 0.0 else k[[0, 4, 2, 5]]
        if not ((np.abs(f) <= FARTHEST).all() and (f[:2] >= SHORTEST).all()):
            text = f"camera_info has no focal length or axis of a camera: {f.tolist()} px"
            raise MessageError("focal_length", text)
        key = (*f.tolist(), int(info.width), int(info.height))
        if key != self._key:
            self._key, self._info = key, f
            self._shape, self._rays = (int(info.height), int(info.width)), None

    def points(self, image: Any) -> Points:
        """Points (H, W, 3) float32 of every n-th pixel, see `COLUMNS`, m; NaN = no return.
        Raises `MessageError`: ``camera_info`` before there is one, ``encoding``, ``size``."""
        if self._info is None:
            raise MessageError("camera_info", "a depth image came before any depth/camera_info")
        height, width = int(image.height), int(image.width)
        if image.encoding not in ENCODINGS:
            text = f"depth image of encoding '{image.encoding}'; known are {', '.join(ENCODINGS)}"
            raise MessageError("encoding", text)
        kind, unit = ENCODINGS[image.encoding]
        data, size = bytes_of(image.data), int(kind[1])
        sound = 0 < height * width <= MAX_POINTS and image.step >= width * size
        if not sound or data.size < (height - 1) * image.step + width * size:
            text = f"depth image of {width} x {height} {image.encoding} has {data.size} bytes"
            raise MessageError("size", text + f", {image.step} a row")
        if (height, width) != self._shape:
            text = f"depth image of {width} x {height}, camera_info of {self._shape[1]} x"
            raise MessageError("size", f"{text} {self._shape[0]}")
        order = ">" if image.is_bigendian else "<"
        whole = np.ndarray((height, width), order + kind, data, 0, (image.step, size))
        step, f = max(round(width / COLUMNS), 1), self._info
        if self._rays is None:
            self._rays = self._pixel_rays(height, width, step)
        z = np.asarray(whole[step // 2 :: step, step // 2 :: step], dtype=np.float32)
        with np.errstate(invalid="ignore", over="ignore"):  # numbers may be any
            z = z * np.float32(unit)
            z[~((z > 0.0) & (z < np.inf))] = np.nan
            most = STEEP * z / np.float32(f[0])
            most += JUMP * (self._lidar.range_noise + self._lidar.stereo_noise * z * z)
            flying = np.zeros(z.shape, dtype=np.bool_)
            for of, own, limit, out in (
                (whole[:, step // 2 :: step], z, most, flying),
                (whole[step // 2 :: step].T, z.T, most.T, flying.T),
            ):  # those that have a neighbour on either side
                first, count = step // 2, len(of)
                some = slice(int(first == 0), (count - 2 - first) // step + 1)
                at = first + step * some.start, first + step * (some.stop - 1) + 1
                sides = (of[at[0] + k : at[1] + k : step] * np.float32(unit) for k in (-1, 1))
                out[some] |= _between(own[some], *sides, limit[some])
        self.edges = int(np.count_nonzero(flying))
        z[flying] = np.nan
        points = np.empty((*z.shape, 3), dtype=np.float32)
        with np.errstate(over="ignore"):
            np.multiply(self._rays, z[..., None], out=points[..., :2])
        points[..., 2] = z
        return points

    def _pixel_rays(self, height: int, width: int, step: int) -> Array:
        """Return (H, W, 2) float32 x / z and y / z of the used pixels."""
        u, v = np.meshgrid(
            np.arange(step // 2, width, step, dtype=np.float64),
            np.arange(step // 2, height, step, dtype=np.float64),
        )
        f = self._info
        return np.stack([(u - f[2]) / f[0], (v - f[3]) / f[1]], axis=-1).astype(np.float32)


def _between(z: Points, before: Points, after: Points, most: Points) -> Array:
    """Return whether depths lie between those of both neighbours, by more than ``most`` from each;
    a neighbour of depth 0 has no return."""
    down, up = z - before, after - z
    there = (before > 0.0) & (after > 0.0)
    return there & (((down > most) & (up > most)) | ((down < -most) & (up < -most)))
