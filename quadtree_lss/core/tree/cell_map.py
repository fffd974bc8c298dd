# SPDX-License-Identifier: Apache-2.0
"""The map as it is published: what landing site selection sees of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core.tree.domain import Domain
from quadtree_lss.core.tree.leaves import leaf_raster

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class CellMap:
    """What the mapping publishes: one row per leaf in Morton order, map frame, m and rad.

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
        exception_fraction: (M,) Eq. 48.
        feature: (M, 5) A, k, mu_x, mu_y (about the centre), sigma of Eq. 51; NaN for none. k^2 is
            the volume, k^2 / (2 pi sigma^2) the height (``geometry.feature.widened``).
        observed: (n, n) [iy, ix], True for finest cells in which a point fell.
        offset_z: By how much the ground of the newest scan that could be compared with the map lay
            over it by its pose: the map's height plus this is the height by navigation, m. NaN if
            none could be compared.
        offset_variance: Of ``offset_z``, m^2.
    """

    stamp_ns: int
    domain: Domain
    level: NDArray[np.uint8]
    ix: NDArray[np.uint32]
    iy: NDArray[np.uint32]
    z: Array
    normal: Array
    covariance_range: Array
    covariance_pose: Array
    count: NDArray[np.uint32]
    measured: Mask
    roughness: Array
    exception_fraction: Array
    feature: Array
    observed: Mask
    offset_z: float = float("nan")
    offset_variance: float = float("nan")

    @property
    def size(self) -> Array:
        """(M,) side of each leaf, m."""
        return self.domain.cell_size(self.level)

    @property
    def x(self) -> Array:
        """(M,) cell centre, m."""
        return self.domain.xmin + (self.ix + 0.5) * self.size

    @property
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

    def leaf_raster(self) -> NDArray[np.int32]:
        """(n, n) [iy, ix] row of the leaf that covers each finest cell."""
        out = np.zeros((self.domain.finest_count,) * 2, dtype=np.int32)
        leaf_raster(self.level, self.ix, self.iy, out)
        return out
