# SPDX-License-Identifier: Apache-2.0
"""The user's grid of candidate sites: values on it, and the best of its nodes."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core.tree.quadtree import Domain

Array = NDArray[np.float64]
Bits = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]
Kind = TypeVar("Kind", bound=np.generic)


def best_nodes(
    score: Array,
    x: Array,
    y: Array,
    count: int,
    separation: float,
    first: tuple[int, int] | None = None,
) -> tuple[Index, Index]:
    """Rows and columns of the ``count`` lowest scores, each ``separation`` from those before.

    Args:
        score: (ny, nx), NaN where a node is excluded; of equal ones the south-western comes first.
        x, y: (nx,), (ny,) grid nodes, m.
        count: Most nodes wanted.
        separation: Least distance of any two, m.
        first: A node to begin with whatever its score, or None.
    """
    left = np.where(np.isnan(score), np.inf, score)
    rows: list[int] = []
    columns: list[int] = []
    while len(rows) < count:
        best = int(np.argmin(left))
        row, column = divmod(best, left.shape[1])
        if not rows and first is not None:
            row, column = first
        if not np.isfinite(left[row, column]):
            break
        rows.append(row)
        columns.append(column)
        near_y = np.flatnonzero(np.abs(y - y[row]) <= separation)
        near_x = np.flatnonzero(np.abs(x - x[column]) <= separation)
        square = (y[near_y] - y[row])[:, None] ** 2 + (x[near_x] - x[column]) ** 2
        block = left[np.ix_(near_y, near_x)]
        left[np.ix_(near_y, near_x)] = np.where(square < separation**2, np.inf, block)
        left[row, column] = np.inf
    return np.array(rows, dtype=np.intp), np.array(columns, dtype=np.intp)


class GridSampler:
    """Values on the finest lattice seen from the user's grid.

    A grid node that coincides with a lattice node takes its value; one between lattice nodes is
    judged by all (up to four) around it.
    """

    def __init__(self, domain: Domain, x: Array, y: Array) -> None:
        n, side = domain.finest_count, domain.finest_size
        column, row = (x - domain.xmin) / side, (y - domain.ymin) / side
        self.column0 = np.clip(np.floor(column + 1e-6).astype(np.intp), 0, n)
        self.row0 = np.clip(np.floor(row + 1e-6).astype(np.intp), 0, n)
        self.column1 = np.clip(np.ceil(column - 1e-6).astype(np.intp), 0, n)
        self.row1 = np.clip(np.ceil(row - 1e-6).astype(np.intp), 0, n)
        self.u = np.clip(column - self.column0, 0.0, 1.0)
        self.v = np.clip(row - self.row0, 0.0, 1.0)[:, None]

        self.on_lattice = bool(
            (self.row0 == self.row1).all() and (self.column0 == self.column1).all()
        )

    def _corners(self, values: NDArray[Kind]) -> tuple[NDArray[Kind], ...]:
        """Values of the four lattice nodes around, or of the one that grid nodes coincide with."""
        low = values[self.row0]
        if self.on_lattice:
            return (low[:, self.column0],)
        high = values[self.row1]
        return (
            low[:, self.column0],
            low[:, self.column1],
            high[:, self.column0],
            high[:, self.column1],
        )

    def everywhere(self, values: Mask) -> Mask:
        """True where all surrounding lattice nodes are."""
        return np.asarray(np.logical_and.reduce(self._corners(values)), dtype=np.bool_)

    def any(self, values: Bits) -> Bits:
        """Bits set in any surrounding lattice node."""
        return np.asarray(np.bitwise_or.reduce(self._corners(values)), dtype=np.uint8)

    def nearest(self, values: Array) -> Array:
        """Value of the nearest lattice node."""
        row = np.where(self.v[:, 0] < 0.5, self.row0, self.row1)
        return values[row][:, np.where(self.u < 0.5, self.column0, self.column1)]

    def lattice(self, rows: Index, columns: Index) -> tuple[Index, Index]:
        """Row and column of the lattice nodes nearest to grid nodes (K,)."""
        row = np.where(self.v[:, 0] < 0.5, self.row0, self.row1)
        return row[rows], np.where(self.u < 0.5, self.column0, self.column1)[columns]

    def linear(self, values: Array) -> Array:
        """Bilinear interpolation."""
        corners = self._corners(values)
        if self.on_lattice:
            return corners[0]
        a, b, c, d = corners
        u, v = self.u, self.v
        out: Array = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
        return out
