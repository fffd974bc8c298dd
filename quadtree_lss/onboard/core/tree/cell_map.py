# SPDX-License-Identifier: Apache-2.0
"""The map as it is published: what landing site selection sees of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array, Bytes, Index, Ints, Mask, Numbers
from quadtree_lss.onboard.core.geometry.bounds import clamp_heights
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.core.tree.leaves import leaf_raster

#: Peak of the bell that fits a hemisphere (Eq. 53) best over the hemisphere's height.
SHAPE = 1.25


def peak(feature: Array) -> Array:
    """Height of features over their surroundings, k^2 / (2 pi sigma^2): (..., 5) to (...), m."""
    return np.asarray(feature[..., 1] ** 2 / (2.0 * np.pi * feature[..., 4] ** 2))


def height_by_error(normal: Array, x: Array, y: Array) -> Array:
    """Return the derivative (K, 3) of planes' heights at ``x``, ``y`` (K,), m from their origins,
    by their errors: a tilt along the axes of Eq. 2, rad, and a shift along ``normal`` (K, 3), m."""
    nx, ny, nz = normal.T
    share, rise = 1.0 / (1.0 + nz), -(x * nx + y * ny) / nz
    along = x * nx + y * ny
    first = x - share * nx * along - nx * rise
    second = y - share * ny * along - ny * rise
    return np.asarray(np.column_stack([-first, -second, np.ones_like(x)]) / nz[:, None])


class Ground(NamedTuple):
    """The ground at places, arrays of their shape: height, m, and its standard deviation by the
    plane's covariance, m; NaN where there is no estimate."""

    height: Array
    slope_deg: Array
    deviation: Array


@dataclass(frozen=True, repr=False)
class CellMap:
    """The published map: one row per leaf in Morton order, map frame, m and rad.

    Attributes:
        stamp_ns: Stamp of the newest scan in the map, 0 if there is none; see `Mapper`.
        domain: Extent and levels.
        level: (M,) uint8.
        ix, iy: (M,) uint32 index at the leaf's own level.
        z: (M,) elevation of the plane at the cell's centre, NaN where there is no estimate.
        normal: (M, 3) upward unit normal.
        covariance_range: (M, 3, 3) part of the covariance of (dphi_1, dphi_2, dd), d about
            (x, y, z), that comes from range noise (independent between cells).
        covariance_pose: (M, 3, 3) part from pose error (common to neighbouring cells).
        count: (M,) uint32 measurements in the estimate.
        measured: (M,) True where the cell's own points were fitted, False if it is empty or
            inherited its plane.
        roughness: (M,) roughness density of Eq. 55 without its noise floor, m^3.
        exception_fraction: (M,) Eq. 48, less what noise alone makes of it.
        feature: (M, 5) A, k, mu_x, mu_y (about the centre), sigma of Eq. 51; NaN for none. k^2 is
            the volume, `peak` the height.
        low, high: (M,) lowest and highest height of a return in the leaf, m, which bound the
            plane's heights (``geometry.bounds``); NaN where there is no bound.
        coverage: (M,) mean share of the 4 x 4 parts of a known finest cell that returns fell on.
        observed: (n, n) [iy, ix], True for finest cells in which a point fell.
        known: (n, n) of these, the cells whose returns were compared with the plane of their leaf,
            or of the leaf it was divided from, and did not stand out. The others are not mapped.
        offset_z: Height of the newest compared scan over the map by its pose, m: the map's height
            plus this is the height by navigation. NaN if none could be compared.
        offset_variance: Of ``offset_z``, m^2.
    """

    stamp_ns: int
    domain: Domain
    level: Bytes
    ix: Numbers
    iy: Numbers
    z: Array
    normal: Array
    covariance_range: Array
    covariance_pose: Array
    count: Numbers
    measured: Mask
    roughness: Array
    exception_fraction: Array
    feature: Array
    low: Array
    high: Array
    coverage: Array
    observed: Mask
    known: Mask
    offset_z: float = float("nan")
    offset_variance: float = float("nan")

    @cached_property
    def size(self) -> Array:
        """(M,) side of each leaf, m."""
        return self.domain.cell_size(self.level)

    @cached_property
    def x(self) -> Array:
        """(M,) cell centre, m."""
        return self.domain.xmin + (self.ix + 0.5) * self.size

    @cached_property
    def y(self) -> Array:
        """(M,) cell centre, m."""
        return self.domain.ymin + (self.iy + 0.5) * self.size

    @property
    def covariance(self) -> Array:
        """(M, 3, 3) total covariance of (dphi_1, dphi_2, dd)."""
        return self.covariance_range + self.covariance_pose

    @property
    def estimated(self) -> Mask:
        """(M,) True where there is a plane, measured or inherited."""
        return np.isfinite(self.z)

    def at(self, x: ArrayLike, y: ArrayLike) -> Ground:
        """Return the ground at places ``x``, ``y``, map frame, m, of any shapes that broadcast.

        Rocks that stand out of a plane are not in its height (``feature``). A place on a border
        belongs to the cell north and east of it.
        """
        at_x, at_y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        place_x, place_y = at_x.ravel(), at_y.ravel()
        domain = self.domain
        with np.errstate(invalid="ignore"):
            off = np.stack([place_y - domain.ymin, place_x - domain.xmin])
            cell = np.floor(off / domain.finest_size)
            inside = ((cell >= 0) & (cell < domain.finest_count)).all(axis=0)
        out = np.full((3, len(place_x)), np.nan)
        row, column = cell[:, inside].astype(np.intp)
        leaf = self.leaf_raster()[row, column]
        normal = self.normal[leaf]
        east, north = place_x[inside] - self.x[leaf], place_y[inside] - self.y[leaf]
        out[0, inside] = self.heights(leaf, place_x[inside], place_y[inside])
        out[1, inside] = np.degrees(np.arccos(np.clip(normal[:, 2], -1.0, 1.0)))
        by = height_by_error(normal, east, north)
        variance = np.einsum("ki,kij,kj->k", by, self.covariance[leaf], by)
        out[2, inside] = np.sqrt(np.maximum(variance, 0.0))
        height, slope, deviation = (values.reshape(at_x.shape)[()] for values in out)
        return Ground(height, slope, deviation)

    def heights(self, leaf: Index | Ints, x: Array, y: Array) -> Array:
        """Heights (...) of the planes of leaves, rows (...), at x, y (...), within bounds, m."""
        normal = self.normal[leaf]
        along = normal[..., 0] * (x - self.x[leaf]) + normal[..., 1] * (y - self.y[leaf])
        return clamp_heights(self.z[leaf] - along / normal[..., 2], self.low[leaf], self.high[leaf])

    def leaf_raster(self) -> Ints:
        """(n, n) [iy, ix] row of the leaf that covers each finest cell."""
        out = np.zeros((self.domain.finest_count,) * 2, dtype=np.int32)
        leaf_raster(self.level, self.ix, self.iy, out)
        return out
