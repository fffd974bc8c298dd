# SPDX-License-Identifier: Apache-2.0
"""Isolated returns: noise, multipath, dust.

Returns are linked if they are neighbours within the gate; a return is isolated if fewer than
three hang together with it, itself included. So neither a single stray return stays nor two that
happen to meet, while the last return of a row needs no more than one good neighbour.

In an organised scan neighbours are the four pixels next to one and the distance is the difference
in range; otherwise all points are neighbours and the distance is that in space. Most of these lie
near those before and behind them in the scan. For the others, points are sorted into cubes whose
diagonal is the gate: three in a cube hang together, the rest look around them. The gate widens
to five times the scan's usual distance, the median of that to the second nearest neighbour: what
a coarse view of slanted ground needs. Scans of fewer than three returns are not judged.
"""

from __future__ import annotations

from functools import lru_cache

import cython
import numpy as np

from quadtree_lss.onboard.arrays import Array, Bytes, Ints, Keys

if cython.compiled:
    from cython.cimports.libc.math import INFINITY, NAN, sqrt
else:
    from math import inf as INFINITY
    from math import nan as NAN
    from math import sqrt

#: The gate is at least so many usual distances.
WIDENING = 5.0
#: So many pixels, or points, tell the usual distance.
SAMPLED, SAMPLED_POINTS = 1024, 256
#: A narrower gate of points in space, m, is taken for this one.
LEAST_GATE = 1e-6
#: Steps of the golden section take a sample from all over a scan, whatever raster that is in.
GOLDEN = 0.6180339887498949
_STEPS = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 3), axis=-1).reshape(-1, 3)
_STEPS = np.ascontiguousarray(_STEPS[np.argsort((_STEPS**2).sum(axis=1), kind="stable")])
#: (125, 3) the cubes that may hold a point within sqrt(3) sides of one, the nearest first.
AROUND = cython.declare(cython.longlong[:, ::1], _STEPS)


def isolated_in_image(ranges: Array, gate: float) -> int:
    """Make the ranges (H, W) of isolated returns NaN, which means none; how many they were.
    ``ranges``: m. ``gate``: m; 0 keeps every return."""
    pixels = np.empty(ranges.size, dtype=np.int32)
    few = pixels_with_few_links(ranges, gate, pixels) if gate > 0.0 else 0
    if few:  # a wider gate leaves no return alone that a narrower one does not
        few = pixels_without_hold(ranges, gate, pixels[:few])
    if few == 0 or few < 3 and np.count_nonzero(ranges > 0.0) < 3:
        return 0
    sample = spread_over(ranges.size, min(ranges.size, SAMPLED))
    steps = np.empty(len(sample))
    limit = max(gate, WIDENING * median(steps[: second_steps(ranges, sample, steps)]))
    lonely = pixels[: pixels_without_hold(ranges, limit, pixels[:few])]
    ranges.reshape(-1)[lonely] = np.nan
    return len(lonely)


def median(values: Array) -> float:
    """The middle one of (N,), 0 if there is none."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle]) if len(values) else 0.0


@lru_cache(maxsize=16)
def spread_over(count: int, sample: int) -> Ints:
    """Places (sample,) among ``count``, ``sample`` at most, from all over them."""
    if sample == count:
        return np.arange(count, dtype=np.int32)
    return (np.arange(sample) * GOLDEN % 1.0 * count).astype(np.int32)


@cython.boundscheck(False)
@cython.locals(ranges=cython.double[:, ::1], pixels=cython.int[::1])
def pixels_with_few_links(ranges: Array, limit: float, pixels: Ints) -> cython.Py_ssize_t:
    """Returns with fewer than two links: their places in (H, W) to ``pixels``, how many.

    In a row without a step beyond the limit only the first and the last pixel may be such.
    """
    cython.declare(row=cython.Py_ssize_t, column=cython.Py_ssize_t, linked=cython.Py_ssize_t)
    few: cython.Py_ssize_t = 0
    width: cython.Py_ssize_t = ranges.shape[1]
    with cython.nogil:
        for row in range(ranges.shape[0]):
            linked = 0
            for column in range(width - 1):
                # A number and not a truth, which compilers do not count two at a time.
                step = abs(ranges[row, column + 1] - ranges[row, column])
                link = 1.0 if step <= limit else 0.0
                linked += cython.cast(cython.int, link)
            column = 0
            while column < width:
                if ranges[row, column] > 0.0 and pixel_links(ranges, row, column, limit) < 2:
                    pixels[few] = row * width + column
                    few += 1
                column += max(linked, 1) if linked == width - 1 else 1
    return few


@cython.boundscheck(False)
@cython.locals(ranges=cython.double[:, ::1], pixels=cython.int[::1])
def pixels_without_hold(ranges: Array, limit: float, pixels: Ints) -> cython.Py_ssize_t:
    """Those of ``pixels`` (M,) that are isolated, to the front of them; how many."""
    i: cython.Py_ssize_t
    lonely: cython.Py_ssize_t = 0
    width: cython.Py_ssize_t = ranges.shape[1]
    with cython.nogil:
        for i in range(pixels.shape[0]):
            if not pixel_holds(ranges, pixels[i] // width, pixels[i] % width, limit):
                pixels[lonely] = pixels[i]
                lonely += 1
    return lonely


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(ranges=cython.double[:, ::1])
def pixel_holds(
    ranges: Array, row: cython.Py_ssize_t, column: cython.Py_ssize_t, limit: float
) -> cython.bint:
    """True if a return is linked with two others, or with one that is linked with two."""
    links: cython.Py_ssize_t = 0
    cython.declare(k=cython.Py_ssize_t, r=cython.Py_ssize_t, c=cython.Py_ssize_t)
    for k in range(4):
        if step_to(ranges, row, column, k) <= limit:
            links += 1
            r = row + (k == 2) - (k == 3)
            c = column + (k == 0) - (k == 1)
            if links == 2 or pixel_links(ranges, r, c, limit) == 2:
                return True
    return False


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(ranges=cython.double[:, ::1])
def pixel_links(
    ranges: Array, row: cython.Py_ssize_t, column: cython.Py_ssize_t, limit: float
) -> cython.Py_ssize_t:
    """With how many of the four next to it a pixel is linked, counted to two."""
    links: cython.Py_ssize_t = 0
    k: cython.Py_ssize_t
    for k in range(4):
        links += step_to(ranges, row, column, k) <= limit
        if links == 2:
            break
    return links


@cython.boundscheck(False)
@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(ranges=cython.double[:, ::1])
def step_to(
    ranges: Array, row: cython.Py_ssize_t, column: cython.Py_ssize_t, k: cython.Py_ssize_t
) -> float:
    """Range difference of a pixel to the k-th of the four next to it; infinite if there is none."""
    r: cython.Py_ssize_t = row + (k == 2) - (k == 3)
    c: cython.Py_ssize_t = column + (k == 0) - (k == 1)
    step: float = INFINITY
    if 0 <= r < ranges.shape[0] and 0 <= c < ranges.shape[1]:
        step = abs(ranges[r, c] - ranges[row, column])
    return step


@cython.boundscheck(False)
@cython.locals(ranges=cython.double[:, ::1], pixels=cython.int[::1], steps=cython.double[::1])
def second_steps(ranges: Array, pixels: Ints, steps: Array) -> cython.Py_ssize_t:
    """Second least step from each of ``pixels`` (M,) to those next to it, to ``steps`` (M,), m;
    how many of them have two neighbours."""
    cython.declare(i=cython.Py_ssize_t, k=cython.Py_ssize_t)
    cython.declare(row=cython.Py_ssize_t, column=cython.Py_ssize_t)
    known: cython.Py_ssize_t = 0
    with cython.nogil:
        for i in range(pixels.shape[0]):
            least = INFINITY
            second = INFINITY
            row = pixels[i] // ranges.shape[1]
            column = pixels[i] - row * ranges.shape[1]
            for k in range(4):
                step = step_to(ranges, row, column, k)
                if step < least:
                    second = least
                    least = step
                elif step < second:
                    second = step
            if second < INFINITY:
                steps[known] = second
                known += 1
    return known


def isolated_in_space(points: Array, ranges: Array, gate: float) -> int:
    """Make the ranges (N,) of isolated points (N, 3) NaN, which means none; how many they were.
    ``points``: in any axes, m. ``ranges``: m; finite where there is a return. ``gate``: m; 0 keeps
    every return."""
    returns = int(np.count_nonzero(ranges > 0.0)) if gate > 0.0 else 0
    if returns < 3:
        return 0
    limit = max(gate, WIDENING * usual_distance(points, ranges, returns), LEAST_GATE)
    sure = np.empty(len(points), dtype=np.uint8)
    if linked_in_order(points, ranges, limit, sure) == returns:
        return 0
    # The diagonal of a cube is a little less than the gate: points of one cube are linked.
    per_metre = 1.7320509 / limit
    slots = 1 << (returns + returns // 2).bit_length()
    cubes, last = np.zeros(slots, dtype=np.int64), np.zeros(slots, dtype=np.int32)
    before, slot = np.empty((2, len(points)), dtype=np.int32)
    fill(points, ranges, per_metre, cubes, last, before, slot)
    return int(drop(points, ranges, limit, per_metre, cubes, last, before, slot, sure))


def usual_distance(points: Array, ranges: Array, returns: int) -> float:
    """Median distance to the second nearest point, from a sample of one in k.

    Ground is a surface, so such a sample lies sqrt(k) times as far apart.
    """
    chosen = spread_over(len(points), min(len(points), SAMPLED_POINTS))
    sample = points[chosen[ranges[chosen] > 0.0]]
    if len(sample) < 3:
        return 0.0
    distances = np.empty(len(sample))
    second_distances(sample, distances)
    return float(median(distances) * np.sqrt(len(sample) / returns))


@cython.boundscheck(False)
@cython.locals(points=cython.double[:, ::1], distances=cython.double[::1])
def second_distances(points: Array, distances: Array) -> None:
    """Distance (N,) of each point (N, 3) to the second nearest other, by looking at all."""
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    with cython.nogil:
        for i in range(points.shape[0]):
            least = 1e300
            second = 1e300
            for j in range(points.shape[0]):
                x = points[j, 0] - points[i, 0]
                y = points[j, 1] - points[i, 1]
                z = points[j, 2] - points[i, 2]
                square = x * x + y * y + z * z
                if square < second and j != i:
                    second = max(square, least)
                    least = min(square, least)
            distances[i] = sqrt(second)


@cython.boundscheck(False)
@cython.locals(points=cython.double[:, ::1], ranges=cython.double[::1], sure=cython.uchar[::1])
def linked_in_order(points: Array, ranges: Array, limit: float, sure: Bytes) -> cython.Py_ssize_t:
    """How many points (N, 3) are linked with two of the four that are next in the scan's order.
    ``sure``: (N,) for 1 where a point is, else 0."""
    cython.declare(i=cython.Py_ssize_t, k=cython.Py_ssize_t, links=cython.int)
    found: cython.Py_ssize_t = 0
    with cython.nogil:
        for i in range(points.shape[0]):
            links = 0
            k = max(i - 2, 0)
            while links < 2 and k < min(i + 3, points.shape[0]) and ranges[i] > 0.0:
                if k != i and ranges[k] > 0.0:
                    x = points[k, 0] - points[i, 0]
                    y = points[k, 1] - points[i, 1]
                    z = points[k, 2] - points[i, 2]
                    links += x * x + y * y + z * z <= limit * limit
                k += 1
            sure[i] = links >= 2
            found += sure[i]
    return found


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def cube_of(
    column: cython.longlong, row: cython.longlong, layer: cython.longlong
) -> cython.longlong:
    """Code of a cube, 20 bits an axis: cubes so far apart that they share one do no harm."""
    return ((layer & 0xFFFFF) << 40) | ((row & 0xFFFFF) << 20) | (column & 0xFFFFF)


@cython.boundscheck(False)
@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(cubes=cython.longlong[::1])
def slot_of(cubes: Keys, cube: cython.longlong) -> cython.Py_ssize_t:
    """Where a cube stands in the table, or would. Eight in a row lie side by side."""
    column: cython.longlong = cube & 0xFFFFF
    row: cython.longlong = (cube >> 20) & 0xFFFFF
    mixed: cython.longlong = (column >> 3) * 83492791
    mixed ^= (row * 73856093) ^ ((cube >> 40) * 19349663)
    mask: cython.Py_ssize_t = cubes.shape[0] - 1
    slot: cython.Py_ssize_t = ((mixed << 3) | (column & 7)) & mask
    while cubes[slot] != 0 and cubes[slot] >> 2 != cube:
        slot = (slot + 1) & mask
    return slot


@cython.boundscheck(False)
@cython.locals(points=cython.double[:, ::1], ranges=cython.double[::1], cubes=cython.longlong[::1])
@cython.locals(last=cython.int[::1], before=cython.int[::1], slots=cython.int[::1])
def fill(
    points: Array,
    ranges: Array,
    per_metre: float,
    cubes: Keys,
    last: Ints,
    before: Ints,
    slots: Ints,
) -> None:
    """Sort points (N, 3) that have a range into cubes of side 1 / ``per_metre``.

    Args:
        cubes: (T,) of zeros, T a power of two; becomes four times the cube's code plus its number
            of points, at most three.
        last: (T,) of zeros; becomes one plus the last point of the cube.
        before: (N,) one plus the point before each one in its cube, 0 for none.
        slots: (N,) where each point's cube stands in the table.
    """
    i: cython.Py_ssize_t
    slot: cython.Py_ssize_t = 0
    cube: cython.longlong
    latest: cython.longlong = -1
    with cython.nogil:
        for i in range(points.shape[0]):
            if not ranges[i] > 0.0:
                continue
            # Shifted by half the codes, so that cutting off the fraction rounds down.
            cube = cube_of(
                cython.cast(cython.longlong, points[i, 0] * per_metre + 524288.0),
                cython.cast(cython.longlong, points[i, 1] * per_metre + 524288.0),
                cython.cast(cython.longlong, points[i, 2] * per_metre + 524288.0),
            )
            if cube != latest:
                slot = slot_of(cubes, cube)
                latest = cube
            if cubes[slot] == 0:
                cubes[slot] = cube << 2
            if cubes[slot] & 3 != 3:
                cubes[slot] += 1
            before[i] = last[slot]
            last[slot] = i + 1
            slots[i] = slot


@cython.boundscheck(False)
@cython.locals(points=cython.double[:, ::1], ranges=cython.double[::1], cubes=cython.longlong[::1])
@cython.locals(last=cython.int[::1], before=cython.int[::1], slots=cython.int[::1])
@cython.locals(sure=cython.uchar[::1])
def drop(
    points: Array,
    ranges: Array,
    limit: float,
    per_metre: float,
    cubes: Keys,
    last: Ints,
    before: Ints,
    slots: Ints,
    sure: Bytes,
) -> cython.Py_ssize_t:
    """Make the ranges of isolated points NaN; how many. The table is that of `fill`. ``sure``: (N,)
    of `linked_in_order`."""
    cython.declare(i=cython.Py_ssize_t, k=cython.Py_ssize_t, links=cython.Py_ssize_t)
    dropped: cython.Py_ssize_t = 0
    linked = cython.declare(cython.Py_ssize_t[1])
    other = cython.declare(cython.Py_ssize_t[1])
    with cython.nogil:
        for i in range(points.shape[0]):
            if sure[i] or not ranges[i] > 0.0 or cubes[slots[i]] & 3 == 3:
                continue
            links = point_links(points, i, limit, per_metre, cubes, last, before, linked)
            if links == 1:
                k = linked[0]
                links = point_links(points, k, limit, per_metre, cubes, last, before, other)
            if links < 2:
                ranges[i] = NAN
                dropped += 1
    return dropped


@cython.boundscheck(False)
@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(points=cython.double[:, ::1], cubes=cython.longlong[::1], last=cython.int[::1])
@cython.locals(before=cython.int[::1], linked=cython.p_Py_ssize_t)
def point_links(
    points: Array,
    point: cython.Py_ssize_t,
    limit: float,
    per_metre: float,
    cubes: Keys,
    last: Ints,
    before: Ints,
    linked: Ints,
) -> cython.Py_ssize_t:
    """With how many others a point is linked, counted to two; ``linked`` (1,) is the first."""
    cython.declare(k=cython.Py_ssize_t, slot=cython.Py_ssize_t, other=cython.Py_ssize_t)
    links: cython.Py_ssize_t = 0
    cython.declare(axis=cython.Py_ssize_t, step=cython.Py_ssize_t)
    cython.declare(x_step=cython.longlong, y_step=cython.longlong, z_step=cython.longlong)
    cube = cython.declare(cython.longlong[3])
    gap = cython.declare(cython.double[15])
    x = points[point, 0]
    y = points[point, 1]
    z = points[point, 2]
    for axis in range(3):
        place = points[point, axis] * per_metre + 524288.0
        cube[axis] = cython.cast(cython.longlong, place)
        for step in range(5):
            # How far the cube two or one before, here, one or two behind is away, in sides.
            apart = max(cube[axis] + step - 2 - place, place - cube[axis] - step + 1, 0.0)
            gap[5 * axis + step] = apart * apart
    for k in range(AROUND.shape[0]):
        x_step, y_step, z_step = AROUND[k, 0], AROUND[k, 1], AROUND[k, 2]
        if gap[2 + x_step] + gap[7 + y_step] + gap[12 + z_step] > 3.000001:
            continue
        slot = slot_of(cubes, cube_of(cube[0] + x_step, cube[1] + y_step, cube[2] + z_step))
        other = last[slot] - 1
        while other >= 0:
            dx = points[other, 0] - x
            dy = points[other, 1] - y
            dz = points[other, 2] - z
            if other != point and dx * dx + dy * dy + dz * dz <= limit * limit:
                linked[0] = other if links == 0 else linked[0]
                links += 1
                if links == 2:
                    return links
            other = before[other] - 1
    return links
