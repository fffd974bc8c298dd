# SPDX-License-Identifier: Apache-2.0
"""The lattice of grid points (corners of finest cells): means over discs, and distances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

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
        row, column: (K,) index offset of each cell from the grid point's (the cell to its
            north-east).
        x, y: (K,) offset of each cell's centre from the grid point, m.
        to_plane: (3, K) maps the heights of the cells to height, dz/dx and dz/dy of their
            least-squares plane (see `ground_planes`).
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


@dataclass(frozen=True)
class GroundPlanes:
    """Least-squares planes of the map over a disc about each grid point: arrays (n + 1, n + 1).

    Attributes:
        elevation: Height at the grid point, m.
        slope_x, slope_y: dz/dx, dz/dy.
        gradient: Rise over run.
    """

    elevation: Array
    slope_x: Array
    slope_y: Array
    gradient: Array


def ground_planes(elevation: Array, needed: Mask, side: float, radius: float) -> GroundPlanes:
    """Fit planes at the vehicle's scale.

    A disc about a grid point is symmetric, so the normal equations are diagonal:
    slope_x = sum(x z) / sum(x^2), slope_y likewise, height = mean(z). Beyond the domain, the cells
    at its border continue.

    Args:
        elevation: (n, n) height of the finest cells, m.
        needed: (n, n) cells whose grid points need planes; elsewhere all values are 0.
        side: Side of the finest cells, m.
        radius: Of the disc, m.
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


def distance_from(marked: Mask, side: float, limit: float = np.inf) -> Array:
    """Compute the distance of each point to the nearest marked one, m, infinite if none is marked.

    Args:
        marked: (ny, nx).
        side: Step of the lattice, m.
        limit: Greater distances may be reported as infinite, m.
    """
    return _distances(marked, lambda steps: steps * side, limit / side)


def dilate(marked: Mask, distance: float, side: float, short: float = 0.0) -> Mask:
    """Return the points within a distance of a marked one, and the marked ones.

    Args:
        marked: (ny, nx).
        distance: m.
        side: Step of the lattice, m.
        short: Subtracted from each distance, steps.
    """
    limit = distance / side + short
    limit += 1e-9 * limit
    if limit < 1.0 or not marked.any():
        return marked.copy()
    away = _distances(marked, lambda steps: (steps - short) * side, limit)
    return marked | (away <= distance)


def _distances(marked: Mask, length: Callable[[Array], Array], limit: float) -> Array:
    """Return a function of the distances in steps; infinite beyond ``limit`` steps."""
    if not marked.any():
        return np.full(marked.shape, np.inf)
    if limit >= MAX_STEPS:
        from scipy.ndimage import distance_transform_edt  # slow to import

        return length(distance_transform_edt(~marked))
    far = int(limit) + 1
    lengths = length(np.sqrt(np.arange(far**2 + 1)))
    lengths[far**2] = np.inf
    out = np.empty(marked.shape)
    find_distances(np.ascontiguousarray(marked).view(np.uint8), lengths, far, out)
    return out


def nearest_marked(marked: Mask) -> Ints:
    """Return the flat index (ny, nx) of the nearest marked point, of two the southern one.

    SciPy's distance transform finds the same points in six times the time. ``marked``: (ny, nx), at
    least one True.
    """
    nearest = np.empty(marked.shape, dtype=np.int32)
    find_nearest(np.ascontiguousarray(marked).view(np.uint8), nearest)
    return nearest


@cython.boundscheck(False)
@cython.locals(
    cells=cython.double[:, ::1], half=cython.Py_ssize_t[::1], needed=cython.uchar[:, ::1]
)
@cython.locals(out=cython.double[:, :, ::1])
def disc_moments(
    cells: Array, level: float, half: Index, needed: Bytes, square: float, out: Array
) -> None:
    """Compute means of z, and of x z and y z over ``square``, over the disc of each grid point.

    x and y are counted from the grid point, in cells. A disc is a stack of centred runs of cells,
    and the sum of a run is a difference of cumulative sums. Beyond the lattice, the cells at its
    border continue.

    Args:
        cells: (n, n) z.
        level: Subtracted from z, which keeps the sums small.
        half: (2 reach,) half width of the disc in each row, cells.
        needed: (n, n), in each row the points from the first to the last at such cells are set.
        square: Divisor of the moments, besides the number of cells.
        out: (4, n + 1, n + 1), set to the means of z, x z and y z, and the norm of the latter two,
            0 where not needed; or (1, n + 1, n + 1) for the mean of z only.
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
@cython.locals(marked=cython.uchar[:, ::1], x=cython.double[::1], y=cython.double[::1])
@cython.locals(free_distance=cython.double[::1])
def lower_free_distance(
    marked: Bytes, half: float, x: Array, y: Array, side: float, reach: float, free_distance: Array
) -> None:
    """Lower ``free_distance`` (K,) to the distance of each point to marked cells less ``reach``, m.

    Args:
        marked: (ny, nx) cells (``half`` = 0.5) or points (``half`` = 0) of a lattice.
        half: Half the width of a marked cell or point, steps.
        x, y: (K,) points, from the first point of the lattice, m.
        side: Step of the lattice, m.
        reach: m.
        free_distance: (K,) m.
    """
    cython.declare(k=cython.Py_ssize_t, i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    cython.declare(ring=cython.Py_ssize_t, row=cython.Py_ssize_t, column=cython.Py_ssize_t)
    farthest: cython.Py_ssize_t = max(marked.shape[0], marked.shape[1])
    with cython.nogil:
        for k in range(x.shape[0]):
            u, v = x[k] / side, y[k] / side
            column, row = cython.cast(cython.Py_ssize_t, u), cython.cast(cython.Py_ssize_t, v)
            ring = 0
            # Everything outside of a ring is at least as many steps away.
            while (ring - 1) * side - reach < free_distance[k] and ring <= farthest:
                for i in range(row - ring, row + ring + 1):
                    if not 0 <= i < marked.shape[0]:
                        continue
                    j = column - ring
                    while j <= column + ring:
                        if 0 <= j < marked.shape[1] and marked[i, j]:
                            dx = max(fabs(u - j - half) - half, 0.0)
                            dy = max(fabs(v - i - half) - half, 0.0)
                            free_distance[k] = min(
                                free_distance[k], sqrt(dx * dx + dy * dy) * side - reach
                            )
                        j += 1 if i == row - ring or i == row + ring else 2 * ring
                ring += 1


@cython.boundscheck(False)
@cython.locals(values=cython.float[:, ::1])
def blur(values: Single, weights: Array) -> Single:
    """Average padded values along each row in single precision, and transpose.

    Args:
        values: (ny, nx + K + 2); the last 3 columns are not used.
        weights: (K,); values farther away are 1 and have the rest of the weight, 1 - sum.

    Returns:
        (nx, ny) means.
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
@cython.locals(marked=cython.uchar[:, ::1], nearest=cython.int[:, ::1])
def find_nearest(marked: Bytes, nearest: Ints) -> None:
    """Find nearest marked points in two sweeps (Meijster, Roerdink and Hesselink 2000).

    First the nearest marked point in each column; then along each row the lower envelope of the
    parabolas (x - column)^2 + (distance in the column)^2. ``marked``: (ny, nx). ``nearest``: (ny,
    nx), set to flat indices; one outside the lattice if none is marked.
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


@cython.boundscheck(False)
@cython.locals(marked=cython.uchar[:, ::1], lengths=cython.double[::1], out=cython.double[:, ::1])
def find_distances(marked: Bytes, lengths: Array, far: cython.short, out: Array) -> None:
    """Compute distances to near marked points in two vectorised sweeps.

    Along a row, each `SPAN` is searched as far as any of its points needs.

    Args:
        marked: (ny, nx).
        lengths: (far^2 + 1,) distance for each squared number of steps; the last is for ``far``
            steps and more.
        far: Steps, at most 127: the sum of two squares fits into 16 bits.
        out: (ny, nx), set.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t, z=cython.short)
    cython.declare(east=cython.short, away=cython.short, beyond=cython.short)
    cython.declare(widest=cython.short, other=cython.short)
    cython.declare(nearest=cython.short, west=cython.Py_ssize_t, count=cython.Py_ssize_t)
    most: cython.short = far
    rows: cython.Py_ssize_t = marked.shape[0]
    columns: cython.Py_ssize_t = marked.shape[1]
    near = cython.declare(cython.short[:, ::1], np.full((rows, columns), far, dtype=np.int16))
    height = cython.declare(cython.short[::1], np.full(columns + 2 * far, far**2, dtype=np.int16))
    least = cython.declare(cython.short[::1], np.empty(SPAN + SPAN // 2, dtype=np.int16))
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
                count = columns - west
                count = count if count < SPAN + SPAN // 2 else SPAN
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
                    away, beyond, widest = k * k, (k + 1) * (k + 1), 0
                    for j in range(count):
                        z, east = height[west + most + j - k], height[west + most + j + k]
                        z = (z if z < east else east) + away
                        z = z if z < least[j] else least[j]
                        other = height[west + most + j - k - 1]
                        east = height[west + most + j + k + 1]
                        other = (other if other < east else east) + beyond
                        z = least[j] = z if z < other else other
                        widest = z if z > widest else widest
                    k += 2
                for j in range(count):
                    out[i, west + j] = lengths[least[j]]
                west += count
