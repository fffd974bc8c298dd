# SPDX-License-Identifier: Apache-2.0
"""What the landing zones about a few places meet."""

from __future__ import annotations

import cython

from quadtree_lss.onboard.arrays import Array, Bytes, Index, Ints

if not cython.compiled:
    from math import fabs, sqrt


@cython.boundscheck(False)
def greatest_in_zones(
    cells: Array, leaf: Ints, of_leaf: Array, half: Index, places: Index, out: Array
) -> None:
    """Greatest of some values of cells and of leaves in the discs about grid points.

    Args:
        cells: (n, n), none below 0.
        leaf: (n, n) row of the leaf over each cell; of_leaf: (M,), none below 0.
        half: (2 reach,) half width of a disc in each row, in cells.
        places: (2, K) rows and columns of the grid points.
        out: (2, K), set: of the cells, of the leaves.
    """
    cython.declare(k=cython.Py_ssize_t, i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    cython.declare(row=cython.Py_ssize_t, west=cython.Py_ssize_t, east=cython.Py_ssize_t)
    last: cython.Py_ssize_t = cells.shape[0] - 1
    reach: cython.Py_ssize_t = half.shape[0] // 2
    with cython.nogil:
        for k in range(places.shape[1]):
            out[0, k] = out[1, k] = 0.0
            for i in range(2 * reach):
                row = places[0, k] + i - reach
                if not 0 <= row <= last:
                    continue
                west, east = places[1, k] - half[i], places[1, k] + half[i]
                for j in range(max(west, 0), min(east, last + 1)):
                    out[0, k] = max(out[0, k], cells[row, j])
                    out[1, k] = max(out[1, k], of_leaf[leaf[row, j]])


@cython.boundscheck(False)
def lower_room(
    marked: Bytes, half: float, x: Array, y: Array, side: float, reach: float, room: Array
) -> None:
    """How far a zone at each of some places may move until it comes too near to what is marked.

    Args:
        marked: (ny, nx) cells, or points of the lattice.
        half: Half the side of those, in steps: 0.5 for cells and 0 for points.
        x, y: (K,) of the places, from the lattice's first point, m.
        side: Of the lattice, m.
        reach: How near the zone's centre may come, m.
        room: (K,) m, lowered.
    """
    cython.declare(k=cython.Py_ssize_t, i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    cython.declare(ring=cython.Py_ssize_t, row=cython.Py_ssize_t, column=cython.Py_ssize_t)
    with cython.nogil:
        for k in range(x.shape[0]):
            u, v = x[k] / side, y[k] / side
            column, row = cython.cast(cython.Py_ssize_t, u), cython.cast(cython.Py_ssize_t, v)
            ring = 0
            # What lies beyond a ring of places is at least as many steps away.
            while (ring - 1) * side - reach < room[k]:
                for i in range(row - ring, row + ring + 1):
                    if not 0 <= i < marked.shape[0]:
                        continue
                    j = column - ring
                    while j <= column + ring:
                        if 0 <= j < marked.shape[1] and marked[i, j]:
                            dx = max(fabs(u - j - half) - half, 0.0)
                            dy = max(fabs(v - i - half) - half, 0.0)
                            room[k] = min(room[k], sqrt(dx * dx + dy * dy) * side - reach)
                        j += 1 if i == row - ring or i == row + ring else 2 * ring
                ring += 1
