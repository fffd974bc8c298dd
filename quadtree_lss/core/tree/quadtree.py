# SPDX-License-Identifier: Apache-2.0
"""The quadtree (paper III.A) as a table of leaves and a lookup from finest cell to leaf.

Every leaf is a row; division turns one row into four. A point finds its leaf through the finest
cell it lies in, without descending the tree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

CHILD_X = np.array([0, 1, 0, 1])
CHILD_Y = np.array([0, 0, 1, 1])


@dataclass(frozen=True)
class Domain:
    """The square that is mapped, map frame.

    Attributes:
        xmin, ymin: South-western corner, m.
        size: Side, m.
        min_level, max_level: A cell of level l has side size / 2^l.
    """

    xmin: float
    ymin: float
    size: float
    min_level: int
    max_level: int

    @property
    def finest_count(self) -> int:
        """Finest cells along a side."""
        return 1 << self.max_level

    @property
    def finest_size(self) -> float:
        """Side of the finest cell, m."""
        return self.size / self.finest_count

    def cell_size(self, level: NDArray[np.integer] | int) -> Array:
        """Side in m of cells of ``level``, any shape."""
        return self.size / np.exp2(np.asarray(level, dtype=np.float64))


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
            the volume, k^2 / (2 pi sigma^2) the height (``bump.as_boulder``).
        observed: (n, n) [iy, ix], True for finest cells in which a point fell.
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
        n = self.domain.finest_count
        raster = np.zeros(n * n, dtype=np.int32)
        fill_blocks(raster, self.domain, self.level, self.ix, self.iy, np.arange(len(self.level)))
        return raster.reshape(n, n)


def fill_blocks(
    raster: NDArray[np.int32],
    domain: Domain,
    level: NDArray[np.integer],
    ix: NDArray[np.integer],
    iy: NDArray[np.integer],
    values: NDArray[np.integer],
) -> None:
    """Write ``values`` (K,) to all finest cells under the cells (level, ix, iy), each (K,).

    One vectorised assignment per level that occurs.
    """
    n = domain.finest_count
    for of_level in np.flatnonzero(np.bincount(level)).tolist():
        chosen = np.flatnonzero(level == of_level)
        side = 1 << (domain.max_level - of_level)
        first = iy[chosen].astype(np.intp) * (side * n) + ix[chosen].astype(np.intp) * side
        within = (np.arange(side)[:, None] * n + np.arange(side)).ravel()
        raster[first[:, None] + within] = values[chosen, None]


def morton_order(
    domain: Domain,
    level: NDArray[np.integer],
    ix: NDArray[np.integer],
    iy: NDArray[np.integer],
) -> Index:
    """Order of leaves (K,) along the Z curve: neighbours in space are near in the table."""
    shift = (domain.max_level - level.astype(np.int64)).astype(np.uint64)
    code = _spread(ix.astype(np.uint64) << shift)
    code |= _spread(iy.astype(np.uint64) << shift) << np.uint64(1)
    return np.argsort(code, kind="stable")


def _spread(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Bits of up to 16-bit numbers moved to the even places."""
    v = values.astype(np.uint64)
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        v = (v | (v << np.uint64(shift))) & np.uint64(mask)
    return v


class Quadtree:
    """Leaves of the tree as growing columns, divided to the minimum level at the start.

    Further columns are declared by a subclass with ``declare`` before ``plant``; a new leaf's
    entries hold the column's empty value. Columns have ``capacity`` rows, of which the first
    ``count`` are leaves; a division may replace the arrays by longer ones.

    Attributes:
        count: Number of leaves.
        level, ix, iy: Place of each row.
        x, y: Cell centre of each row, m.
        leaf_of_finest: (n*n,) row of the leaf over each finest cell, index iy * n + ix.
    """

    level: NDArray[np.uint8]
    ix: NDArray[np.int32]
    iy: NDArray[np.int32]
    x: Array
    y: Array

    def __init__(self, domain: Domain, max_cells: int) -> None:
        self.domain = domain
        self.max_cells = max_cells
        self.count = 0
        self.capacity = 0
        self.leaf_of_finest = np.zeros(domain.finest_count**2, dtype=np.int32)
        self._empty: dict[str, float] = {}
        self.declare("level", 0, (), np.uint8)
        self.declare("ix", 0, (), np.int32)
        self.declare("iy", 0, (), np.int32)
        self.declare("x", 0.0)
        self.declare("y", 0.0)

    def declare(
        self,
        name: str,
        empty: float,
        shape: tuple[int, ...] = (),
        kind: type[np.generic] = np.float64,
    ) -> None:
        """Add the column ``name``; each row has ``shape`` and starts as ``empty``."""
        self._empty[name] = empty
        setattr(self, name, np.full((self.capacity, *shape), empty, dtype=kind))

    def plant(self) -> None:
        """Forget all leaves and divide to the minimum level."""
        for name, empty in self._empty.items():
            getattr(self, name)[...] = empty
        side = 1 << self.domain.min_level
        self._reserve(side * side)
        self.count = side * side
        rows = np.arange(self.count)
        level = np.full(self.count, self.domain.min_level)
        self._place(rows, level, rows % side, rows // side)

    def _place(self, rows: Index, level: Index, ix: Index, iy: Index) -> None:
        self.level[rows], self.ix[rows], self.iy[rows] = level, ix, iy
        size = self.domain.cell_size(level)
        self.x[rows] = self.domain.xmin + (ix + 0.5) * size
        self.y[rows] = self.domain.ymin + (iy + 0.5) * size
        fill_blocks(self.leaf_of_finest, self.domain, level, ix, iy, rows)

    def _reserve(self, rows: int) -> None:
        if rows <= self.capacity:
            return
        self.capacity = max(rows, min(2 * self.capacity, self.max_cells))
        for name, empty in self._empty.items():
            old = getattr(self, name)
            grown = np.full((self.capacity, *old.shape[1:]), empty, dtype=old.dtype)
            grown[: self.count] = old[: self.count]
            setattr(self, name, grown)

    def split(self, rows: Index) -> Index:
        """Divide leaves ``rows`` (K,), which lie below the maximum level.

        Returns:
            (K', 4) rows of the children, x fastest; K' < K where ``max_cells`` leaves no room: the
            last ones stay whole. The first child takes over the parent's row, columns and all; the
            others start empty.
        """
        rows = rows[: max((self.max_cells - self.count) // 3, 0)]
        fresh = self.count + np.arange(3 * len(rows)).reshape(-1, 3)
        self._reserve(self.count + fresh.size)
        self.count += fresh.size
        children = np.concatenate([rows[:, None], fresh], axis=1)
        level = np.repeat(self.level[rows].astype(np.intp) + 1, 4)
        ix = (2 * self.ix[rows].astype(np.intp)[:, None] + CHILD_X).ravel()
        iy = (2 * self.iy[rows].astype(np.intp)[:, None] + CHILD_Y).ravel()
        self._place(children.ravel(), level, ix, iy)
        return children
