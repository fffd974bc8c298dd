# SPDX-License-Identifier: Apache-2.0
"""The lattice of grid points (corners of finest cells): means over discs, and distances."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import inf
from typing import NamedTuple, TypeVar

import cython
import numpy as np
from cython.cimports.libc.math import fabs, sqrt
from numpy.typing import NDArray

from quadtree_lss.onboard.arrays import Array, Bytes, Index, Ints, Mask, Single

#: Most steps for `find_distances`; beyond, SciPy's distance transform is faster.
MAX_STEPS = 126
#: Points of a row whose distances are computed together.
SPAN = cython.declare(cython.Py_ssize_t, 64)
Kind = TypeVar("Kind", bound=np.generic)


@dataclass(frozen=True)
class Disc:
    """Finest cells whose centre lies within a radius of a grid point.

    Attributes:
        reach: Cells from the grid point to the disc's edge.
        row, column: (K,) index offset of each cell from the one north-east of the grid point.
        x, y: (K,) offset of each cell's centre from the grid point, m.
        to_plane: (3, K) maps the cells' heights to height, dz/dx and dz/dy of `ground_planes`.
        half: (2 reach,) half width of the disc in each row, from the southernmost, cells.
    """

    reach: int
    row: Index
    column: Index
    x: Array
    y: Array
    to_plane: Array
    half: Index


@lru_cache(maxsize=16)
def disc(radius: float, side: float) -> Disc:
    """Return the cells of a side within a radius of a grid point, at least four; both m."""
    reach = max(int(np.ceil(radius / side)), 1)
    offset = np.arange(-reach, reach)
    row, column = np.repeat(offset, 2 * reach), np.tile(offset, 2 * reach)
    x, y = (column + 0.5) * side, (row + 0.5) * side
    inside = np.hypot(x, y) <= max(radius, 0.75 * side)
    half = np.count_nonzero(inside.reshape(2 * reach, 2 * reach), axis=1) // 2
    x, y = x[inside], y[inside]
    to_plane = np.stack([np.full(len(x), 1.0 / len(x)), x / np.sum(x**2), y / np.sum(y**2)])
    return Disc(reach, row[inside], column[inside], x, y, to_plane, half)


def disc_means(values: Array, over: Disc, needed: Mask) -> Array:
    """Return means of cell values (n, n) over the disc of each grid point at a ``needed`` cell."""
    out = np.empty((1, len(values) + 1, len(values) + 1))
    disc_moments(values, 0.0, over.half, needed.view(np.uint8), 1.0, out)
    return np.asarray(out[0])


class GroundPlanes(NamedTuple):
    """Least-squares planes of the map over a disc about each grid point, (n + 1, n + 1): height, m,
    dz/dx, dz/dy, and their norm."""

    elevation: Array
    slope_x: Array
    slope_y: Array
    gradient: Array


def ground_planes(elevation: Array, needed: Mask, side: float, radius: float) -> GroundPlanes:
    """Fit planes to the elevation (n, n) in a disc about each grid point at a ``needed`` cell.

    A disc about a grid point is symmetric, so the normal equations are diagonal:
    slope_x = sum(x z) / sum(x^2), slope_y likewise, height = mean(z). Beyond the domain, the cells
    at its border continue. ``side``: of the finest cells, m. ``radius``: of the disc, m.
    """
    over = disc(radius, side)
    square = side * float(np.mean((over.x / side) ** 2))
    out = np.empty((4, len(elevation) + 1, len(elevation) + 1))
    disc_moments(elevation, np.mean(elevation), over.half, needed.view(np.uint8), square, out)
    return GroundPlanes(*out)


def corner_bits(cells: Bytes) -> Bytes:
    """Combine the bits of the up to four cells at each grid point: (n, n) to (n + 1, n + 1).

    The nearest point of a cell to a grid point is one of its corners, so the distance to the
    nearest corner of a marked cell is the distance to the cell's edge.
    """
    rows, columns = cells.shape
    out = np.zeros((rows + 1, columns + 1), dtype=np.uint8)
    out[:rows, :columns] = cells
    flat = out.ravel()  # the last value of a row is 0, so rows do not mix
    for step in (1, columns + 1):
        flat[step:] |= flat[:-step]
    return out


def with_neighbours(values: NDArray[Kind]) -> NDArray[Kind]:
    """Return the maximum of each point and its four neighbours, (ny, nx)."""
    out = values.copy()
    for one, other in ((out, values), (out.T, values.T)):
        np.maximum(one[1:], other[:-1], out=one[1:])
        np.maximum(one[:-1], other[1:], out=one[:-1])
    return out


def distance_from(marked: Mask, side: float, limit: float = inf) -> Array:
    """Compute the distance of each point (ny, nx) of a lattice to the nearest marked one, m.

    Infinite if none is marked; also beyond ``limit``, m, if that is short. ``side``: of a step, m.
    """
    steps = limit / side * (1.0 + 1e-9)
    if not marked.any():
        return np.full(marked.shape, inf)
    if steps >= MAX_STEPS:
        from scipy.ndimage import distance_transform_edt  # slow to import

        return np.asarray(distance_transform_edt(~marked) * side)
    far = int(steps) + 1
    lengths = np.sqrt(np.arange(far**2 + 1)) * side
    lengths[far**2] = inf
    out = np.empty(marked.shape)
    find_distances(np.ascontiguousarray(marked).view(np.uint8), lengths, far, out)
    return out


def dilate(marked: Mask, distance: float, side: float) -> Mask:
    """Return the points (ny, nx) within a distance of a marked one, m; arguments as above."""
    if distance < side:
        return marked.copy()
    return np.asarray(distance_from(marked, side, distance) <= distance)


@cython.boundscheck(False)
@cython.locals(marked=cython.uchar[:, ::1], half=cython.double, x=cython.double, y=cython.double)
@cython.locals(limit=cython.double)
def steps_to_marked(marked: Bytes, half: float, x: float, y: float, limit: float) -> float:
    """Return the distance of a point to the nearest of the marks (ny, nx), steps, up to ``limit``.

    A mark is a cell with a width of two times ``half`` = 0.5, or a point with ``half`` = 0. ``x``,
    ``y``: from the first point of the lattice, steps.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, east=cython.Py_ssize_t)
    with cython.nogil:
        for i in range(marked.shape[0]):
            dy = max(fabs(y - i - half) - half, 0.0)
            if dy >= limit:
                continue
            east = min(cython.cast(cython.Py_ssize_t, x + limit) + 1, marked.shape[1])
            for j in range(max(cython.cast(cython.Py_ssize_t, x - limit) - 1, 0), east):
                if marked[i, j]:
                    dx = max(fabs(x - j - half) - half, 0.0)
                    limit = min(limit, sqrt(dx * dx + dy * dy))
    return limit


@cython.boundscheck(False)
@cython.locals(
    cells=cython.double[:, ::1], half=cython.Py_ssize_t[::1], needed=cython.uchar[:, ::1]
)
@cython.locals(out=cython.double[:, :, ::1])
def disc_moments(
    cells: Array, level: float, half: Index, needed: Bytes, square: float, out: Array
) -> None:
    """Set ``out`` (4, n + 1, n + 1) to means over the disc of each grid point: z, x z and y z over
    ``square``, and the norm of the latter two. With (1, n + 1, n + 1), only to the mean of z.

    x and y are counted from the grid point, in cells. A disc is a stack of centred runs of cells
    with a ``half`` width (2 reach,), and the sum of a run is a difference of cumulative sums, which
    ``level``, subtracted from z, keeps small. Beyond the lattice, the cells (n, n) at its border
    continue. In each row, the points from the first to the last at ``needed`` cells (n, n) are set;
    the others are 0.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
    cython.declare(row=cython.Py_ssize_t, east=cython.Py_ssize_t, west=cython.Py_ssize_t)
    cython.declare(first=cython.Py_ssize_t, after=cython.Py_ssize_t)
    n: cython.Py_ssize_t = cells.shape[0]
    rows: cython.Py_ssize_t = half.shape[0]
    reach: cython.Py_ssize_t = rows // 2
    slopes: cython.bint = out.shape[0] > 1
    mean = cython.declare(cython.double[:, ::1], out[0])
    along_x = cython.declare(cython.double[:, ::1], out[1 if slopes else 0])
    along_y = cython.declare(cython.double[:, ::1], out[2 if slopes else 0])
    length = cython.declare(cython.double[:, ::1], out[3 if slopes else 0])
    share: cython.double = 0.5 / np.sum(half)
    moment: cython.double = share / square
    # A ring buffer of the rows within reach.
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
                length[row, :] = 0.0
            first, after = n, 0
            for k in range(max(row - 1, 0), min(row + 1, n)):
                j = 0
                while j < first and not needed[k, j]:
                    j += 1
                first, j = j, n
                while j > after and not needed[k, j - 1]:
                    j -= 1
                after = j
            after = after + 1 if first < n else first
            # The disc is symmetric: the row as far to the north has a run of equal width.
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
                # Two loops: the compiler does not vectorise one over all arrays.
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
                    length[row, j] = sqrt(x * x + y * y)  # powers are rounded differently
            for j in range(first, after):
                mean[row, j] = level + share * mean[row, j]


@cython.boundscheck(False)
@cython.locals(values=cython.float[:, ::1])
def blur(values: Single, weights: Array) -> Single:
    """Average padded values (ny, nx + K + 2) along each row in single precision, and transpose.

    The last 3 columns are not used. Values farther away than the ``weights`` (K,) reach are 1, and
    have the rest of the weight, 1 - sum.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
    cython.declare(a=cython.float, b=cython.float, c=cython.float, d=cython.float)
    rows: cython.Py_ssize_t = values.shape[0]
    columns: cython.Py_ssize_t = values.shape[1] - len(weights) - 2
    beyond: cython.float = 1.0 - np.sum(weights)
    # Four weights at a time, so that a sum is stored less often.
    fours = np.zeros((len(weights) + 3) // 4 * 4, dtype=np.float32)
    fours[: len(weights)] = weights
    weight = cython.declare(cython.float[::1], fours)
    line = cython.declare(cython.float[::1], np.empty(columns, dtype=np.float32))
    out = cython.declare(cython.float[:, ::1], np.empty((columns, rows), dtype=np.float32))
    with cython.nogil:
        for i in range(rows):
            line[:] = beyond
            for k in range(0, weight.shape[0], 4):
                a, b, c, d = weight[k], weight[k + 1], weight[k + 2], weight[k + 3]
                for j in range(columns):
                    line[j] += (a * values[i, j + k] + b * values[i, j + k + 1]) + (
                        c * values[i, j + k + 2] + d * values[i, j + k + 3]
                    )
            for j in range(columns):
                out[j, i] = line[j]
    return np.asarray(out)


@cython.boundscheck(False)
@cython.locals(marked=cython.uchar[:, ::1])
def nearest_marked(marked: Bytes) -> Ints:
    """Return the flat index of the nearest marked point (ny, nx), of two the southern one.

    Two sweeps (Meijster, Roerdink and Hesselink 2000), six times as fast as SciPy: first the
    nearest marked point in each column; then along each row the lower envelope of the parabolas
    (x - column)^2 + (distance in the column)^2.
    """
    cython.declare(i=cython.int, j=cython.int, k=cython.int, top=cython.int, last=cython.int)
    cython.declare(x=cython.int, first=cython.int)
    rows: cython.int = marked.shape[0]
    columns: cython.int = marked.shape[1]
    far: cython.int = 2 * (rows + columns)
    nearest = cython.declare(cython.int[:, ::1], np.empty((rows, columns), dtype=np.int32))
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
                # At equal distance the southern one; missing ones have indices far below 0.
                near[i, j] = last if last >= i and last - i < i - k else k
        for i in range(rows):
            for j in range(columns):
                height[j] = (i - near[i, j]) * (i - near[i, j])
                nearest[i, j] = i * columns + j
            last = -1
            while True:
                first = last + 1
                while first < columns and height[first] == 0:
                    first += 1
                if first == columns:
                    break
                # Between two columns marked in this row, no column beyond them is nearer.
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
                    x = 1 + (j + k) // 2  # for equal heights, without a division
                    if height[j] != height[k]:
                        x = 1 + (j * j - k * k + height[j] - height[k]) // (2 * (j - k))
                    if x <= last:
                        top += 1
                        vertex[top], begin[top] = j, x
                for j in range(last, first - 1, -1):
                    k = vertex[top]
                    nearest[i, j] = near[i, k] * columns + k
                    if j == begin[top]:
                        top -= 1
    return np.asarray(nearest)


@cython.boundscheck(False)
@cython.locals(marked=cython.uchar[:, ::1], lengths=cython.double[::1], out=cython.double[:, ::1])
def find_distances(marked: Bytes, lengths: Array, far: cython.short, out: Array) -> None:
    """Set ``out`` (ny, nx) to distances to near marked points, in two vectorised sweeps.

    Along a row, each `SPAN` is searched as far as any of its points needs. ``lengths``: (far^2 +
    1,) distance for each squared number of steps, the last for ``far`` and more. ``far``: at most
    127, so that the sum of two squares fits into 16 bits.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t, z=cython.short)
    cython.declare(east=cython.short, away=cython.short, widest=cython.short, nearest=cython.short)
    cython.declare(west=cython.Py_ssize_t, count=cython.Py_ssize_t)
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
                count = columns - west if columns - west < SPAN else SPAN
                nearest, widest = most * most, 0
                for j in range(count + 2 * most):
                    z = height[west + j]
                    nearest = z if z < nearest else nearest
                for j in range(count):
                    z = least[j] = height[west + most + j]
                    widest = z if z > widest else widest
                k = 1
                # Stop when columns farther away cannot contain a nearer point.
                while k * k + nearest < widest:
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
