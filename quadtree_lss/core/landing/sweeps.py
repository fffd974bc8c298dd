# SPDX-License-Identifier: Apache-2.0
"""Sweeps over the lattice, compiled: sums over discs, and the nearest marked point."""

from __future__ import annotations

import cython
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@cython.boundscheck(False)
def disc_sums(west: Array, half: Index, weight: Array, out: Array) -> None:
    """Weighted sums over the disc of each grid point.

    A disc is a stack of centred runs of cells; the sum of a run is a difference of sums from the
    west.

    Args:
        west: (n + 2 reach, n + 2 reach + 1) sums of the cells west of each border between two.
        half: (2 reach,) half width of the disc in each row, in cells.
        weight: (2 reach,) of each row.
        out: (n + 1, n + 1), set.
    """
    i: cython.Py_ssize_t
    j: cython.Py_ssize_t
    k: cython.Py_ssize_t
    reach: cython.Py_ssize_t = half.shape[0] // 2
    with cython.nogil:
        for i in range(out.shape[0]):
            out[i, :] = 0.0
            for k in range(2 * reach):
                if half[k] == 0:
                    continue
                share = weight[k]
                for j in range(out.shape[1]):
                    out[i, j] += share * (
                        west[i + k, j + reach + half[k]] - west[i + k, j + reach - half[k]]
                    )


@cython.boundscheck(False)
def find_nearest(marked: NDArray[np.uint8], square: NDArray[np.int64], place: Index) -> None:
    """Exact distances in two sweeps (Meijster, Roerdink and Hesselink 2000).

    First the nearest marked point in each column; then along each row the lower envelope of the
    parabolas (x - column)^2 + (distance in the column)^2.

    Args:
        marked: (ny, nx).
        square, place: (ny, nx), set; a place outside the lattice if none is marked.
    """
    i: cython.Py_ssize_t
    j: cython.Py_ssize_t
    k: cython.Py_ssize_t
    top: cython.Py_ssize_t
    last: cython.Py_ssize_t
    x: cython.longlong
    rows: cython.Py_ssize_t = marked.shape[0]
    columns: cython.Py_ssize_t = marked.shape[1]
    far: cython.Py_ssize_t = 2 * (rows + columns)
    near = cython.declare(cython.Py_ssize_t[:, ::1], np.empty((rows, columns), dtype=np.intp))
    height = cython.declare(cython.longlong[::1], np.empty(columns, dtype=np.int64))
    vertex = cython.declare(cython.Py_ssize_t[::1], np.empty(columns, dtype=np.intp))
    begin = cython.declare(cython.longlong[::1], np.empty(columns, dtype=np.int64))
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
