# SPDX-License-Identifier: Apache-2.0
"""Sweeps over the lattice, compiled: sums over discs, and the nearest marked point."""

from __future__ import annotations

import cython
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Places = NDArray[np.int32]


@cython.boundscheck(False)
def disc_moments(cells: Array, half: Index, total: Array, along_x: Array, along_y: Array) -> None:
    """Sums of z, x z and y z over the disc of each grid point, x and y from it in cells.

    A disc is a stack of centred runs of cells, and the sum of a run is a difference of sums from
    the west. Outside the lattice the cells at its edge go on.

    Args:
        cells: (n, n).
        half: (2 reach,) half width of the disc in each row, in cells.
        total, along_x, along_y: (n + 1, n + 1), set; of the last two none if they are empty.
    """
    i: cython.Py_ssize_t
    j: cython.Py_ssize_t
    k: cython.Py_ssize_t
    row: cython.Py_ssize_t
    east: cython.Py_ssize_t
    west: cython.Py_ssize_t
    n: cython.Py_ssize_t = cells.shape[0]
    reach: cython.Py_ssize_t = half.shape[0] // 2
    slopes: cython.bint = along_x.shape[0] > 0
    sums = cython.declare(cython.double[:, :, ::1], np.zeros((2, n + 2 * reach, n + 2 * reach + 1)))
    with cython.nogil:
        for i in range(n + 2 * reach):
            row = min(max(i - reach, 0), n - 1)
            for j in range(n + 2 * reach):
                z = cells[row, min(max(j - reach, 0), n - 1)]
                sums[0, i, j + 1] = sums[0, i, j] + z
                sums[1, i, j + 1] = sums[1, i, j] + (j + 0.5) * z
        for i in range(n + 1):
            total[i, :] = 0.0
            if slopes:
                along_x[i, :] = 0.0
                along_y[i, :] = 0.0
            for k in range(2 * reach):
                if half[k] == 0:
                    continue
                east = reach + half[k]
                west = reach - half[k]
                y = k - reach + 0.5
                if not slopes:
                    for j in range(n + 1):
                        total[i, j] += sums[0, i + k, j + east] - sums[0, i + k, j + west]
                    continue
                for j in range(n + 1):
                    z = sums[0, i + k, j + east] - sums[0, i + k, j + west]
                    total[i, j] += z
                    along_y[i, j] += y * z
                    along_x[i, j] += sums[1, i + k, j + east] - sums[1, i + k, j + west]
            if slopes:
                for j in range(n + 1):
                    along_x[i, j] -= (j + reach) * total[i, j]


@cython.boundscheck(False)
def find_nearest(marked: NDArray[np.uint8], square: Places, place: Places) -> None:
    """Exact distances in two sweeps (Meijster, Roerdink and Hesselink 2000).

    First the nearest marked point in each column; then along each row the lower envelope of the
    parabolas (x - column)^2 + (distance in the column)^2.

    Args:
        marked: (ny, nx).
        square, place: (ny, nx), set; a place outside the lattice if none is marked.
    """
    i: cython.int
    j: cython.int
    k: cython.int
    top: cython.int
    last: cython.int
    x: cython.int
    rows: cython.int = marked.shape[0]
    columns: cython.int = marked.shape[1]
    far: cython.int = 2 * (rows + columns)
    near = cython.declare(cython.int[:, ::1], np.empty((rows, columns), dtype=np.int32))
    height = cython.declare(cython.int[::1], np.empty(columns, dtype=np.int32))
    vertex = cython.declare(cython.int[::1], np.empty(columns, dtype=np.int32))
    begin = cython.declare(cython.int[::1], np.empty(columns, dtype=np.int32))
    with cython.nogil:
        for j in range(columns):
            near[0, j] = 0 if marked[0, j] else -far
        for i in range(1, rows):
            for j in range(columns):
                near[i, j] = i if marked[i, j] else near[i - 1, j]
        for i in range(rows - 2, -1, -1):
            for j in range(columns):
                last = near[i + 1, j]
                k = near[i, j]
                # Of two alike the southern one; far ones lie below the lattice.
                near[i, j] = last if last >= i and last - i < i - k else k
        for i in range(rows):
            for j in range(columns):
                height[j] = (i - near[i, j]) * (i - near[i, j])
            top = 0
            vertex[0] = 0
            begin[0] = 0
            for j in range(1, columns):
                while top >= 0:
                    k = vertex[top]
                    x = begin[top]
                    if (x - k) * (x - k) + height[k] <= (x - j) * (x - j) + height[j]:
                        break
                    top -= 1
                if top < 0:
                    top = 0
                    vertex[0] = j
                    continue
                k = vertex[top]
                x = 1 + (j * j - k * k + height[j] - height[k]) // (2 * (j - k))
                if x < columns:
                    top += 1
                    vertex[top] = j
                    begin[top] = x
            for j in range(columns - 1, -1, -1):
                k = vertex[top]
                square[i, j] = (j - k) * (j - k) + height[k]
                place[i, j] = near[i, k] * columns + k
                if j == begin[top]:
                    top -= 1
