# SPDX-License-Identifier: Apache-2.0
"""A scan brought to the height of the map: the one step that needs all of its cells at once.

Eq. 20 gives each scan of a cell its own offset; pose error is common to all points of a scan, so
here the offset is the scan's. Cells that other scans have seen than their neighbours would
otherwise average other errors: level ground would come out in steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cython
import numpy as np

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.mapping.departure import BEYOND, FLOOR, Departure
from quadtree_lss.onboard.core.tree.leaves import LeafTable

if not cython.compiled:
    HINTS = 1


#: A cell that is off by more deviations than this is of other ground than the map's.
AGREES = 4.5
#: A cell that departs from the others by more than this many deviations counts less.
HUBER = 2.0
#: Variance of a cell's height from what no covariance tells (ground that planes smooth), m^2.
MODEL_VARIANCE = 0.02**2
#: Variance of an exact pose, m^2.
EXACT = 1e-9
#: An offset of so many deviations is a jump of the pose's error.
JUMP = 3.0
#: The map is lifted when it ought to be by so much, m: landing looks anew at ground that moved.
LEAST_LIFT = 5e-4
#: What a single scan counts as, s.
INSTANT = cython.declare(cython.double, 1e-3)
#: Cells seen before that a scan needs to be moved.
MIN_CELLS = 3


@dataclass(frozen=True)
class Offset:
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


def offset_of(cells: Array, now: float, correlation_time: float) -> Offset | None:
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
    pose stays where it is.

    Args:
        cells: (6, M) of `ScanUpdate.compare`.
        now: Time of the scan, s.
        correlation_time: s; 0 if the error is another one in each scan.
    """
    may = cells[1] + cells[2] + cells[3] + FLOOR
    cells = cells[:, cells[0] ** 2 <= AGREES**2 * may]
    rise, own = cells[:2]
    if len(rise) < MIN_CELLS:
        return None
    weight = 1.0 / (own + MODEL_VARIANCE)
    order = np.argsort(rise)
    half = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
    away = np.abs(rise - rise[order[half]]) * np.sqrt(weight)
    weight *= np.minimum(1.0, HUBER / np.maximum(away, HUBER))
    total = float(weight.sum())
    # The products of BLAS end in other bits on other processors.
    height, _, of_scan, _, since, until = ((cells[:6] * weight).sum(axis=1) / total).tolist()
    # On slopes either error is another one: the cell best known for what the scan knows of it.
    of_map = (of_scan + EXACT) * float(np.min(cells[3] / (cells[2] + EXACT)))
    news = 1.0
    if correlation_time > 0.0:
        news -= math.exp(-abs(now - until) / correlation_time)
    noise = 1.0 / total + FLOOR
    if height * height > JUMP**2 * (news * (of_scan + of_map) + noise):
        news = 1.0
    of_scan, of_map = news * of_scan, news * of_map
    if until > since:
        excess = height * height / (JUMP**2 * max(of_scan, of_map, noise))
        of_scan *= min(max(excess, 1.0) ** 3, BEYOND**2)
    share = height / (of_scan + of_map + noise)
    return Offset(height, share * of_scan, share * of_map, since, noise)


def lower(points: Array, found: Departure) -> None:
    """Tilt points (N, 3) about the lidar in place, m, so that a scan lies along the map.

    That is done to a scan that departs by more than is claimed (`JUMP`), and which is not refused:
    fused, it would tilt the map by its share, for pose errors in common decide nothing there.
    """
    (along_x, along_y), (x, y) = found.tilt, found.centre
    points[:, 2] -= along_x * (points[:, 0] - x) + along_y * (points[:, 1] - y)


@cython.boundscheck(False)
def lift(table: LeafTable, height: float, since: float) -> None:
    """Lift the leaves, as far as they share the map's error where a scan was compared with it.

    Their errors are means over scans; of the scans from ``first_time`` to ``last_time`` of a leaf,
    those from ``since`` on are in the ground that was compared, too.

    Args:
        table: The leaves.
        height: m.
        since: s.
    """
    row: cython.Py_ssize_t
    leaf = table.leaf
    for row in range(table.count):
        if leaf[row].known >= HINTS:
            first = leaf[row].first_time
            last = leaf[row].last_time
            shared = (last - max(first, since) + INSTANT) / (last - first + INSTANT)
            rise = height * min(max(shared, 0.0), 1.0)
            leaf[row].z += rise
            leaf[row].low += rise
            leaf[row].high += rise
