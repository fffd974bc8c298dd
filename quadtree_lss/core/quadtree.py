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
        stamp_ns: Stamp of the newest scan in the map, 0 if there is none.
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
        feature: (M, 5) A, k, mu_x, mu_y (about the centre), sigma of Eq. 51; NaN for none.
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
    for of_level in range(domain.max_level + 1):
        chosen = np.flatnonzero(level == of_level)
        if not len(chosen):
            continue
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

    Columns other than the place of the leaf are declared by the owner with ``add_column``; a new
    leaf's entries hold the column's empty value.

    Attributes:
        count: Number of leaves.
        level, ix, iy, x, y: Place of each row; arrays of capacity >= count.
        leaf_of_finest: (n*n,) row of the leaf over each finest cell, index iy * n + ix.
    """

    def __init__(self, domain: Domain, max_cells: int) -> None:
        self.domain = domain
        self.max_cells = max_cells
        self._empty: dict[str, tuple[float, tuple[int, ...], np.dtype[np.generic]]] = {}
        self._columns: dict[str, NDArray[np.generic]] = {}
        self.count = 0
        for name, kind in (("level", np.uint8), ("ix", np.int32), ("iy", np.int32)):
            self.add_column(name, 0, (), kind)
        self.add_column("x", 0.0)
        self.add_column("y", 0.0)
        self._plant()

    def add_column(
        self,
        name: str,
        empty: float,
        shape: tuple[int, ...] = (),
        kind: type[np.generic] = np.float64,
    ) -> None:
        """Declare a column whose rows have ``shape`` and start as ``empty``."""
        self._empty[name] = (empty, shape, np.dtype(kind))
        self._columns[name] = np.full((self.capacity, *shape), empty, dtype=kind)

    @property
    def capacity(self) -> int:
        """Rows allocated."""
        level = self._columns.get("level")
        return 0 if level is None else len(level)

    def column(self, name: str) -> NDArray[np.generic]:
        """The whole column including unused capacity; valid until the next division."""
        return self._columns[name]

    @property
    def level(self) -> NDArray[np.uint8]:
        """Level of each row."""
        return self._columns["level"]  # type: ignore[return-value]

    @property
    def ix(self) -> NDArray[np.int32]:
        """Index along x of each row at its own level."""
        return self._columns["ix"]  # type: ignore[return-value]

    @property
    def iy(self) -> NDArray[np.int32]:
        """Index along y of each row at its own level."""
        return self._columns["iy"]  # type: ignore[return-value]

    @property
    def x(self) -> Array:
        """Cell centre of each row, m."""
        return self._columns["x"]  # type: ignore[return-value]

    @property
    def y(self) -> Array:
        """Cell centre of each row, m."""
        return self._columns["y"]  # type: ignore[return-value]

    def reset(self) -> None:
        """Forget all leaves and divide to the minimum level again."""
        self.count = 0
        for name, (empty, _, _) in self._empty.items():
            self._columns[name][...] = empty
        self._plant()

    def _plant(self) -> None:
        side = 1 << self.domain.min_level
        self._reserve(side * side)
        self.count = side * side
        rows = np.arange(self.count)
        self._place(rows, np.full(self.count, self.domain.min_level), rows % side, rows // side)
        n = self.domain.finest_count
        self.leaf_of_finest = np.zeros(n * n, dtype=np.int32)
        self._claim(rows)

    def _place(self, rows: Index, level: Index, ix: Index, iy: Index) -> None:
        self.level[rows], self.ix[rows], self.iy[rows] = level, ix, iy
        size = self.domain.cell_size(level)
        self.x[rows] = self.domain.xmin + (ix + 0.5) * size
        self.y[rows] = self.domain.ymin + (iy + 0.5) * size

    def _claim(self, rows: Index) -> None:
        fill_blocks(
            self.leaf_of_finest, self.domain, self.level[rows], self.ix[rows], self.iy[rows], rows
        )

    def _reserve(self, rows: int) -> None:
        if rows <= self.capacity:
            return
        target = max(rows, min(2 * self.capacity, self.max_cells), 64)
        for name, (empty, shape, kind) in self._empty.items():
            grown = np.full((target, *shape), empty, dtype=kind)
            grown[: self.count] = self._columns[name][: self.count]
            self._columns[name] = grown

    def divide(self, rows: Index) -> Index:
        """Divide leaves ``rows`` (K,) below the maximum level.

        Returns:
            (K', 4) rows of the children, x fastest; K' < K where ``max_cells`` leaves no room:
            the last ones stay whole. Child columns other than the place are the parent's in the
            first child (it takes over the parent's row) and empty in the others.
        """
        room = (self.max_cells - self.count) // 3
        rows = rows[: max(room, 0)]
        fresh = self.count + np.arange(3 * len(rows)).reshape(-1, 3)
        self._reserve(self.count + fresh.size)
        self.count += fresh.size
        children = np.concatenate([rows[:, None], fresh], axis=1)
        level = np.repeat(self.level[rows].astype(np.intp) + 1, 4)
        ix = (2 * self.ix[rows].astype(np.intp)[:, None] + CHILD_X).ravel()
        iy = (2 * self.iy[rows].astype(np.intp)[:, None] + CHILD_Y).ravel()
        self._place(children.ravel(), level, ix, iy)
        self._claim(children.ravel())
        return children
