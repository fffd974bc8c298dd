# SPDX-License-Identifier: Apache-2.0
"""A scan brought to the height of the map: the one step that needs all of its cells at once.

Eq. 20 gives each scan of a cell its own offset; pose error is common to all points of a scan, so
here the offset is the scan's. Cells that other scans have seen than their neighbours would
otherwise average other errors: level ground would come out in steps.
"""

from __future__ import annotations

from typing import NamedTuple

import cython
import numpy as np
from cython.cimports.libc.math import INFINITY, exp, fabs, sqrt
from cython.cimports.quadtree_lss.onboard.core.mapping import update as row
from cython.cimports.quadtree_lss.onboard.core.tree.leaves import HINTS, LeafTable

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.geometry.bounds import HEIGHTS
from quadtree_lss.onboard.core.mapping.departure import BEYOND, FLOOR, MIN_CELLS, Departure

#: A cell that departs from the others by more than this many deviations counts less.
HUBER = cython.declare(cython.double, 2.0)
#: Variance of a cell's height from what no covariance tells (ground that planes smooth), m^2.
MODEL_VARIANCE = cython.declare(cython.double, 0.02**2)
#: Variance of an exact pose, m^2.
EXACT = cython.declare(cython.double, 1e-9)
#: An offset of so many deviations is a jump of the pose's error.
JUMP = 3.0
#: The map is lifted when it ought to be by so much, m: landing looks anew at ground that moved.
LEAST_LIFT = 5e-4
#: What a single scan counts as, s.
INSTANT = cython.declare(cython.double, 1e-3)
#: A plane is higher or lower at no cell's centre, m.
HIGHEST = cython.declare(cython.double, HEIGHTS)


class Offset(NamedTuple):
    """Where a scan lies by its pose, against the map.

    Attributes:
        height: Of the scan over the map, b, m.
        scan: What of it is the scan's error, to take out of the scan, m.
        map: What of it is the map's, to lift the map by, m.
        since: Mean time of the first scan in the planes that the scan was compared with, s.
        variance: Of ``height``, m^2.
    """

    height: float
    scan: float
    map: float
    since: float
    variance: float


@cython.boundscheck(False)
def offset_of(
    cells: Array, now: float, correlation_time: float, metre: float = 1.0
) -> Offset | None:
    """How a scan's offset from the map divides between the two; None if there is no overlap.

    Over the M cells seen before, the scan's planes stand b over the map's: a weighted mean with
    Huber's weights about the weighted median, of variance R. With S and M the shares
    1 - exp(-dt / correlation_time), which are news, of the variances that pose error gives the
    height of the scan's ground and of the map's best known cell there, to which the others are
    lifted, b = e_scan - e_map + noise is of variance S + M + R, so that S / (S + M + R) of it is
    expected to be the scan's error and M / (S + M + R) the map's. Either is bounded by what it
    claims: a scan of a hopeless pose comes to lie on the map, one of an exact pose moves it, and
    errors that persist stay as they are.

    An offset that is out of proportion to the news, b^2 > `JUMP`^2 (S + M + R), shows a jump: then
    all error is news. If n^2 = b^2 / max(S, M, R) is more than `JUMP`^2, too, and the map is of
    several scans, this one's pose is worse than it claims: S counts (n / `JUMP`)^6 times, but
    `BEYOND`^2 times at most. So the map follows five deviations by less than a tenth, and an exact
    pose stays where it is. ``cells``: of `ScanUpdate.fit`. ``now``: time of the scan, s.
    ``correlation_time``: s; 0 if the error is another one in each scan. ``metre``:
    what the constants above have for one (``VehicleConfig.height``).
    """
    i: cython.Py_ssize_t
    column = cython.declare(cython.double[:, :], cells)
    count: cython.Py_ssize_t = column.shape[1]
    if count < MIN_CELLS:
        return None
    floor: cython.double = FLOOR * metre * metre
    model: cython.double = MODEL_VARIANCE * metre * metre
    exact: cython.double = EXACT * metre * metre
    jump: cython.double = JUMP
    beyond: cython.double = BEYOND
    weights = np.empty(count)
    weight = cython.declare(cython.double[::1], weights)
    for i in range(count):
        weight[i] = 1.0 / (column[row.OWN, i] + model)
    middle: cython.double = weighted_median(cells[row.RISE], weights)
    total = height = of_scan = since = until = 0.0
    least = INFINITY
    for i in range(count):
        away = fabs(column[row.RISE, i] - middle) * sqrt(weight[i])
        w = weight[i] * min(1.0, HUBER / max(away, HUBER))
        total += w
        height += w * column[row.RISE, i]
        of_scan += w * column[row.OF_SCAN, i]
        since += w * column[row.FIRST_TIME, i]
        until += w * column[row.LAST_TIME, i]
        # On slopes either error is another one: the cell best known for what the scan knows of it.
        least = min(least, column[row.OF_MAP, i] / (column[row.OF_SCAN, i] + exact))
    height /= total
    of_scan /= total
    since /= total
    until /= total
    of_map = (of_scan + exact) * least
    news = 1.0
    if correlation_time > 0.0:
        news -= exp(-fabs(now - until) / correlation_time)
    noise = 1.0 / total + floor
    if height * height > jump * jump * (news * (of_scan + of_map) + noise):
        news = 1.0
    of_scan, of_map = news * of_scan, news * of_map
    if until > since:
        excess = max(height * height / (jump * jump * max(of_scan, of_map, noise)), 1.0)
        of_scan *= min(excess * excess * excess, beyond * beyond)
    share = height / (of_scan + of_map + noise)
    return Offset(height, share * of_scan, share * of_map, since, noise)


@cython.boundscheck(False)
def weighted_median(values: Array, weights: Array) -> float:
    """The value of (N,), one at least, up to which in their order half of the weights (N,) lie."""
    i: cython.Py_ssize_t = 0
    order = cython.declare(cython.Py_ssize_t[::1], values.argsort())
    value = cython.declare(cython.double[:], values)
    weight = cython.declare(cython.double[:], weights)
    total = below = 0.0
    for i in range(order.shape[0]):
        total += weight[order[i]]
    for i in range(order.shape[0]):
        below += weight[order[i]]
        if below >= 0.5 * total:
            break
    median: float = value[order[i]]
    return median


def lower(points: Array, found: Departure) -> None:
    """Tilt points (N, 3) about the lidar in place, m, so that a scan lies along the map.

    That is done to a scan that departs by more than is claimed (`JUMP`), and which is not refused:
    fused, it would tilt the map by its share, for pose errors in common decide nothing there.
    """
    # As the offsets (`Mapper`), so that the order of the cells changes no bit.
    along_x, along_y, x, y = (round(of, 9) for of in (*found.tilt, *found.centre))
    points[:, 2] -= along_x * (points[:, 0] - x) + along_y * (points[:, 1] - y)


@cython.boundscheck(False)
@cython.locals(table=LeafTable)
def lift(table: LeafTable, height: float, since: float) -> None:
    """Lift the leaves, as far as they share the map's error where a scan was compared with it.

    Their errors are means over scans; of the scans from ``first_time`` to ``last_time`` of a leaf,
    those from ``since`` on are in the ground that was compared, too. ``table``: the leaves.
    ``height``: m. ``since``: s.
    """
    row: cython.Py_ssize_t
    leaf = table.leaf
    for row in range(table.count):
        if leaf[row].known >= HINTS:
            first = leaf[row].first_time
            last = leaf[row].last_time
            shared = 1.0  # of a leaf in which time went back
            if last >= first:
                shared = (last - max(first, since) + INSTANT) / (last - first + INSTANT)
            rise = height * min(max(shared, 0.0), 1.0)
            leaf[row].z += rise
            leaf[row].low += rise
            leaf[row].high += rise
            if not fabs(leaf[row].z) < HIGHEST:
                table.forget(table.at(row))
