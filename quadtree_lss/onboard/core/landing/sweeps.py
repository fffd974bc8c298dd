# SPDX-License-Identifier: Apache-2.0
"""Sweeps over the lattice, compiled: sums over discs, and the nearest marked point."""

from __future__ import annotations

import cython
import numpy as np

from quadtree_lss.onboard.arrays import Array, Bytes, Index, Ints

if not cython.compiled:  # otherwise from the .pxd
    from math import sqrt

    SPAN = 64


@cython.boundscheck(False)
def disc_moments(
    cells: Array,
    level: float,
    half: Index,
    seen: Bytes,
    square: float,
    mean: Array,
    along_x: Array,
    along_y: Array,
    steep: Array,
) -> None:
    """Means over the disc of each grid point of z, and of x z and y z over ``square``.

    Here x and y are those from the grid point, in cells.

    A disc is a stack of centred runs of cells, and the sum of a run is a difference of sums from
    the west. Outside the lattice the cells at its edge go on.

    Args:
        cells: (n, n).
        level: Sums are of z over this, which keeps them small.
        half: (2 reach,) half width of the disc in each row, in cells.
        seen: (n, n), the points from the first to the last at such cells in a row need means.
        square: What moments are divided by, beside the number of cells.
        mean, along_x, along_y: (n + 1, n + 1), set, 0 where no means are needed; of the last two
            none if they are empty.
        steep: Alike, length of the vector of those two.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
    cython.declare(row=cython.Py_ssize_t, east=cython.Py_ssize_t, west=cython.Py_ssize_t)
    cython.declare(first=cython.Py_ssize_t, after=cython.Py_ssize_t)
    n: cython.Py_ssize_t = cells.shape[0]
    rows: cython.Py_ssize_t = half.shape[0]
    reach: cython.Py_ssize_t = rows // 2
    slopes: cython.bint = along_x.shape[0] > 0
    share: cython.double = 0.5 / np.sum(half)
    moment: cython.double = share / square
    # Of the rows in reach alone: each takes the place of the one that went out of it.
    sums = cython.declare(cython.double[:, :, ::1], np.zeros((2, rows, n + rows + 1)))
    with cython.nogil:
        for i in range(n + rows):
            row = min(max(i - reach, 0), n - 1)
            k = i % rows
            so_far, so_far_x = 0.0, 0.0
            for j in range(n + rows):
                z = cells[row, min(max(j - reach, 0), n - 1)] - level
                so_far += z
                so_far_x += (j + 0.5) * z
                sums[0, k, j + 1], sums[1, k, j + 1] = so_far, so_far_x
            row = i + 1 - rows
            if row < 0:
                continue
            mean[row, :] = 0.0
            if slopes:
                along_x[row, :] = 0.0
                along_y[row, :] = 0.0
                steep[row, :] = 0.0
            first, after = n, 0
            for k in range(max(row - 1, 0), min(row + 1, n)):
                j = 0
                while j < first and not seen[k, j]:
                    j += 1
                first, j = j, n
                while j > after and not seen[k, j - 1]:
                    j -= 1
                after = j
            after = after + 1 if first < n else first
            # The row as far to the north has a run as wide.
            for k in range(reach):
                east, west = reach + half[k], reach - half[k]
                if east == west:
                    continue
                south: cython.Py_ssize_t = (row + k) % rows
                north: cython.Py_ssize_t = (row + rows - 1 - k) % rows
                y = reach - k - 0.5
                if not slopes:
                    for j in range(first, after):
                        z = sums[0, south, j + east] - sums[0, south, j + west]
                        mean[row, j] += z + (sums[0, north, j + east] - sums[0, north, j + west])
                    continue
                # Two loops: the compiler leaves one over all arrays as it is.
                for j in range(first, after):
                    z = sums[0, south, j + east] - sums[0, south, j + west]
                    up = sums[0, north, j + east] - sums[0, north, j + west]
                    mean[row, j] += z + up
                    along_y[row, j] += y * (up - z)
                for j in range(first, after):
                    z = sums[1, south, j + east] - sums[1, south, j + west]
                    along_x[row, j] += z + (sums[1, north, j + east] - sums[1, north, j + west])
            if slopes:
                for j in range(first, after):
                    along_x[row, j] -= (j + reach) * mean[row, j]
                    along_x[row, j] *= moment
                for j in range(first, after):
                    along_y[row, j] *= moment
                for j in range(first, after):
                    x, y = along_x[row, j], along_y[row, j]
                    steep[row, j] = sqrt(x * x + y * y)
            for j in range(first, after):
                mean[row, j] = level + share * mean[row, j]


@cython.boundscheck(False)
def find_nearest(marked: Bytes, square: Ints, place: Ints) -> None:
    """Exact distances in two sweeps (Meijster, Roerdink and Hesselink 2000).

    First the nearest marked point in each column; then along each row the lower envelope of the
    parabolas (x - column)^2 + (distance in the column)^2.

    Args:
        marked: (ny, nx).
        square, place: (ny, nx), set; a place outside the lattice if none is marked.
    """
    cython.declare(i=cython.int, j=cython.int, k=cython.int, top=cython.int, last=cython.int)
    cython.declare(x=cython.int, first=cython.int)
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
                square[i, j], place[i, j] = 0, i * columns + j
            last = -1
            while True:
                first = last + 1
                while first < columns and height[first] == 0:
                    first += 1
                if first == columns:
                    break
                # From a column that is marked in this row to the next: none beyond is nearer.
                last = first
                while last < columns - 1 and height[last] != 0:
                    last += 1
                first = max(first - 1, 0)
                top, vertex[0], begin[0] = 0, first, first
                for j in range(first + 1, last + 1):
                    while top >= 0:
                        k = vertex[top]
                        x = begin[top]
                        if (x - k) * (x - k) + height[k] <= (x - j) * (x - j) + height[j]:
                            break
                        top -= 1
                    if top < 0:
                        top, vertex[0] = 0, j
                        continue
                    k = vertex[top]
                    x = 1 + (j + k) // 2  # where both are as high, without a long division
                    if height[j] != height[k]:
                        x = 1 + (j * j - k * k + height[j] - height[k]) // (2 * (j - k))
                    if x <= last:
                        top += 1
                        vertex[top], begin[top] = j, x
                for j in range(last, first - 1, -1):
                    k = vertex[top]
                    square[i, j] = (j - k) * (j - k) + height[k]
                    place[i, j] = near[i, k] * columns + k
                    if j == begin[top]:
                        top -= 1


@cython.boundscheck(False)
def find_distances(marked: Bytes, lengths: Array, far: cython.short, out: Array) -> None:
    """Distances to marked points that are near, in two sweeps that take eight points at a time.

    Along a row it looks as far as some point of a ``SPAN`` needs it.

    Args:
        marked: (ny, nx).
        lengths: (far^2 + 1,) what is told of each square of a distance in steps, of those of
            ``far`` and more the last.
        far: Steps, 127 at the most: the sum of two squares fits into 16 bits.
        out: (ny, nx), set.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t, z=cython.short)
    cython.declare(east=cython.short, away=cython.short, widest=cython.short)
    cython.declare(nearest=cython.short, west=cython.Py_ssize_t, count=cython.Py_ssize_t)
    most: cython.short = far
    rows: cython.Py_ssize_t = marked.shape[0]
    columns: cython.Py_ssize_t = marked.shape[1]
    near = cython.declare(cython.short[:, ::1], np.full((rows, columns), far, dtype=np.int16))
    height = cython.declare(cython.short[::1], np.full(columns + 2 * far, far**2, dtype=np.int16))
    least = cython.declare(cython.short[::1], np.empty(SPAN, dtype=np.int16))
    with cython.nogil:
        for i in range(rows):
            for j in range(columns):
                z = near[max(i - 1, 0), j] + 1
                z = z if z < most else most
                near[i, j] = 0 if marked[i, j] else z
        for i in range(rows - 2, -1, -1):
            for j in range(columns):
                z = near[i + 1, j] + 1
                near[i, j] = z if z < near[i, j] else near[i, j]
        for i in range(rows):
            for j in range(columns):
                height[j + most] = near[i, j] * near[i, j]
            west = 0
            while west < columns:
                count = min(SPAN, columns - west)
                nearest, widest = most * most, 0
                for j in range(count + 2 * most):
                    z = height[west + j]
                    nearest = z if z < nearest else nearest
                for j in range(count):
                    z = least[j] = height[west + most + j]
                    widest = z if z > widest else widest
                k = 1
                # Columns so far away are no nearer than what is found, or as far as all others.
                while k * k < widest and nearest < most * most:
                    away, widest = k * k, 0
                    for j in range(count):
                        z, east = height[west + most + j - k], height[west + most + j + k]
                        z = (z if z < east else east) + away
                        z = least[j] = z if z < least[j] else least[j]
                        widest = z if z > widest else widest
                    k += 1
                for j in range(count):
                    out[i, west + j] = lengths[least[j]]
                west += SPAN


@cython.boundscheck(False)
def score_density(
    slope: Array,
    near: Array,
    inside: Array,
    subscale: Array,
    leaf: Ints,
    of_leaf: Array,
    weights: Array,
    out: Array,
) -> None:
    """Eq. 58 on the finest cells: the mean of what is said of the four grid points of each.

    Args:
        slope, near, inside: (n + 1, n + 1) rad, and to the nearest hazard, and to ground that is
            unseen or outside, m.
        subscale: (n, n) m.
        leaf: (n, n) row of the leaf over each cell; of_leaf: (M,) what is said of it.
        weights: (4,) of slope, the distance to the nearest hazard, and features, and the distance
            beyond which it is of no more worth, m.
        out: (n, n), set.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    n: cython.Py_ssize_t = leaf.shape[0]
    lines = cython.declare(cython.double[:, ::1], np.empty((2, n + 1)))
    cython.declare(south=cython.Py_ssize_t, north=cython.Py_ssize_t)
    with cython.nogil:
        for i in range(n + 1):
            north, south = i % 2, (i + 1) % 2
            for j in range(n + 1):
                z = near[i, j] if near[i, j] < inside[i, j] else inside[i, j]
                z = z if z < weights[3] else weights[3]
                lines[north, j] = weights[0] * slope[i, j] - weights[1] * z
            if i == 0:
                continue
            for j in range(n):
                z = lines[south, j] + lines[north, j]
                z = 0.25 * (z + (lines[south, j + 1] + lines[north, j + 1]))
                z += of_leaf[leaf[i - 1, j]]
                out[i - 1, j] = z + weights[2] * subscale[i - 1, j]
