# SPDX-License-Identifier: Apache-2.0
"""How far a scan lies from the map, as a rigid motion, and how far it may by what either claims.

Pose error moves all of a scan at once: what M cells say of it in common is known far better than
any of them, and is to be judged by what the pose claims in common.
"""

from __future__ import annotations

from typing import NamedTuple

import cython
import numpy as np
from cython.cimports.libc.math import INFINITY, exp, fabs, sqrt
from cython.cimports.quadtree_lss.onboard.core.geometry.plane import inverse_symmetric
from cython.cimports.quadtree_lss.onboard.core.mapping import update as row

from quadtree_lss.onboard.arrays import Array

#: A cell that departs from the others by more than this many of its deviations counts less: of
#: Gaussian cells one in 22 does.
HUBER = cython.declare(cython.double, 2.0)
#: Rounds of reweighting; a cell's weight then changes by less than a hundredth.
ROUNDS = cython.declare(cython.int, 5)
#: Variance of a cell's height from what no covariance tells (ground that planes smooth), m^2:
#: without it one sound scan in 1,000 over cliffs is refused.
SMOOTHED = cython.declare(cython.double, 0.01**2)
#: Share of a scan's cells in which errors that no rigid motion explains may be the same: a quarter
#: of its width, squared. With a 32nd a sound scan over cliffs is refused.
TOGETHER = cython.declare(cython.double, 1.0 / 16.0)
#: Cells seen within this of each other are of the same scans, s: shorter than scans are apart.
INSTANT = cython.declare(cython.double, 1e-3)
#: Variance of a scan's height that no covariance tells and more cells do not make smaller, m^2:
#: by so much ranges of a lidar are off in common.
FLOOR = 0.04**2
#: A pose that is off by more than it claims may be off by so many times of it; by more, mostly,
#: the scan is refused.
BEYOND = 5.0
#: Cells of which a motion of three degrees of freedom can be told.
MIN_CELLS = 3


class Departure(NamedTuple):
    """A scan's rigid motion from the map.

    Attributes:
        share: Of the cells that stand where both poses may have put them, each by itself.
        height: Of the scan over the map in the middle of these cells, m.
        tilt: (2,) rise along x and along y that the scan's attitude error explains, were its pose
            `BEYOND` times worse than claimed.
        centre: (2,) x and y of that middle about the lidar, m.
        claimed, mapped: Variance of ``height`` from the scan's pose error and from the map's, as
            either claims, m^2.
        noise: The same from the cells' own noise, m^2.
        deviations: Height and tilt over what they may be, sqrt(chi^2); 0 if too few cells tell it.
    """

    share: float
    height: float
    tilt: tuple[float, float]
    centre: tuple[float, float]
    claimed: float
    mapped: float
    noise: float
    deviations: float


@cython.boundscheck(False)
@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(cells=cython.double[:, :], out=cython.p_double)
def _motion(cells: Array, i: cython.Py_ssize_t, out: Array) -> cython.void:
    """J_i (6): by how much a scan's pose error lifts its ground in a cell."""
    x, y, z = cells[row.PLACE_X, i], cells[row.PLACE_Y, i], cells[row.PLACE_Z, i]
    out[0] = -cells[row.SLOPE_X, i]
    out[1] = -cells[row.SLOPE_Y, i]
    out[2] = 1.0
    out[3] = y - z * out[1]
    out[4] = z * out[0] - x
    out[5] = x * out[1] - y * out[0]


@cython.boundscheck(False)
@cython.locals(cells=cython.double[:, :], sigma=cython.double[:, ::1])
@cython.locals(deviation=cython.double[::1], full=cython.double[::1], weight=cython.double[::1])
def departure(
    cells: Array,
    sigma: Array,
    now: float,
    correlation_time: float,
    limit: float,
    metre: float = 1.0,
) -> Departure | None:
    """The rigid motion that M cells have in common, and how likely it is; None of fewer than 3.

    The offsets b_i = h + t.(r_i - r_0) + noise_i give theta = (h, t), height and tilt, by least
    squares: with rows (1, r_i - r_0) of X and W of Huber's weights over v_i, the cell's own
    variance and `SMOOTHED`, theta = A^-1 X^T W b, A = X^T W X. Left out are cells that neither pose
    explains, b_i^2 > limit^2 (v_i + S_i + M_i + `FLOOR`): rocks and wrong ground in the map.

    A pose error e = (dm, dw) lifts the ground of cell i by J_i e, J_i = (m_i, a_i x m_i) of its
    slope g_i, m_i = (-g_i, 1), and its place about the lidar a_i: what is off sideways does it on
    slopes. By the hypothesis that both poses are what they claim, theta is of covariance V, the
    sum of

    - P = T Sigma T^T, T = A^-1 X^T W J: of the scan's pose;
    - the map's, from what its cells claim of height, M, and of slope, Q. Of either height
      variance P_hh + M - 2 rho sqrt(P_hh M) is left of what they have in common, rho =
      exp(-dt / correlation_time), but no less than the larger one: errors may be whiter than is
      said. Tilts likewise; if cells were not seen by the same scans, M across the scan also is
      one: Q + M / (mean square of r - r_0);
    - `FLOOR` of the height;
    - s^2 A^-1 of the cells' own noise, s^2 = (sum of squares over v_i + 3) / max(N, 3) of the
      N = (sum w)^2 / sum w^2 cells that tell it: with three cells more that are as v_i says, less
      the three unknowns. What is in excess of v_i may be the same in `TOGETHER` of them:
      max(s^2 - 1, 0) `TOGETHER` N A^-1 more, so that no rough or partly seen ground is a
      contradiction.

    theta^T V^-1 theta is chi^2 of three degrees of freedom. Were the pose k = `BEYOND` times worse
    than claimed, its error would be k^2 Sigma T^T (k^2 P + V)^-1 theta.

    Args:
        cells: (ROWS, M) of `ScanUpdate.fit`.
        sigma: (6, 6) pose covariance of the scan.
        now: Time of the scan, s.
        correlation_time: s; 0 if the error is another one in each scan.
        limit: Deviations.
        metre: What the constants above have for one (``VehicleConfig.height``).
    """
    right = cython.declare(cython.double[3])
    theta = cython.declare(cython.double[3])
    normal = cython.declare(cython.double[9])
    inverse = cython.declare(cython.double[9])
    lift = cython.declare(cython.double[6])
    moved = cython.declare(cython.double[18])
    takes = cython.declare(cython.double[18])
    scan = cython.declare(cython.double[9])
    total = cython.declare(cython.double[9])
    cython.declare(i=cython.Py_ssize_t, j=cython.int, k=cython.int, m=cython.int, step=cython.int)
    count: cython.Py_ssize_t = cells.shape[1]
    agreeing: cython.Py_ssize_t = 0
    floor: cython.double = FLOOR * metre * metre
    smoothed: cython.double = SMOOTHED * metre * metre
    beyond: cython.double = BEYOND * BEYOND
    if count < MIN_CELLS:
        return None
    kept = cython.declare(cython.Py_ssize_t[::1], np.empty(count, dtype=np.intp))
    # Of the kept cells: deviation, its weight, and Huber's weight.
    deviation, full, weight = np.empty((3, count))
    x0 = y0 = whole = 0.0
    for i in range(count):
        may = cells[row.OWN, i] + cells[row.OF_SCAN, i] + cells[row.OF_MAP, i] + floor
        if cells[row.RISE, i] * cells[row.RISE, i] <= limit * limit * may:
            variance = cells[row.OWN, i] + smoothed
            w = 1.0 / variance
            whole += w
            x0 += w * cells[row.PLACE_X, i]
            y0 += w * cells[row.PLACE_Y, i]
            deviation[agreeing], full[agreeing], kept[agreeing] = sqrt(variance), w, i
            agreeing += 1
    share: cython.double = agreeing
    share /= count
    if agreeing < MIN_CELLS:
        return Departure(share, 0.0, (0.0, 0.0), (0.0, 0.0), 0.0, 0.0, 0.0, 0.0)
    x0 /= whole
    y0 /= whole
    theta[0] = theta[1] = theta[2] = 0.0
    for step in range(ROUNDS + 1):
        for j in range(9):
            normal[j] = 0.0
        right[0] = right[1] = right[2] = 0.0
        for k in range(agreeing):
            i = kept[k]
            x, y = cells[row.PLACE_X, i] - x0, cells[row.PLACE_Y, i] - y0
            off = fabs(cells[row.RISE, i] - theta[0] - theta[1] * x - theta[2] * y)
            w = full[k]
            if off > HUBER * deviation[k]:
                w *= HUBER * deviation[k] / off
            weight[k] = w
            normal[0] += w
            normal[1] += w * x
            normal[2] += w * y
            normal[4] += w * x * x
            normal[5] += w * x * y
            normal[8] += w * y * y
            right[0] += w * cells[row.RISE, i]
            right[1] += w * x * cells[row.RISE, i]
            right[2] += w * y * cells[row.RISE, i]
        inverse_symmetric(normal, inverse)
        if step < ROUNDS:  # the last round only weighs
            for j in range(3):
                theta[j] = 0.0
                for k in range(3):
                    theta[j] += inverse[3 * j + k] * right[k]
    square = weights = mapped = tilted = last = 0.0
    early, late = INFINITY, -INFINITY
    for j in range(18):
        moved[j] = 0.0
    for k in range(agreeing):
        i, w = kept[k], weight[k]
        x, y = cells[row.PLACE_X, i] - x0, cells[row.PLACE_Y, i] - y0
        off = cells[row.RISE, i] - theta[0] - theta[1] * x - theta[2] * y
        _motion(cells, i, lift)
        for m in range(6):  # X^T W J
            moved[m] += w * lift[m]
            moved[6 + m] += w * x * lift[m]
            moved[12 + m] += w * y * lift[m]
        square += w * off * off
        weights += w * w
        mapped += w * cells[row.OF_MAP, i]
        tilted += w * cells[row.OF_SLOPE, i]
        last += w * (cells[row.LAST_TIME, i] - now)
        early = min(early, 0.5 * (cells[row.FIRST_TIME, i] + cells[row.LAST_TIME, i]))
        late = max(late, 0.5 * (cells[row.FIRST_TIME, i] + cells[row.LAST_TIME, i]))
    whole = normal[0]
    mapped /= whole
    tilted /= whole
    other = mapped if late - early > INSTANT else 0.0
    common = 0.0
    if correlation_time > 0.0:
        common = exp(-fabs(last / whole) / correlation_time)
    # As many cells as tell something: one that is hardly known confirms nothing.
    telling = whole * whole / weights
    square = (square + 3.0) / max(telling, 3.0)
    noise = square + max(square - 1.0, 0.0) * TOGETHER * telling
    for j in range(3):
        for k in range(6):
            takes[6 * j + k] = 0.0
            for m in range(3):
                takes[6 * j + k] += inverse[3 * j + m] * moved[6 * m + k]
    for j in range(3):
        for k in range(3):
            scan[3 * j + k] = 0.0
            for m in range(6):
                for step in range(6):
                    scan[3 * j + k] += takes[6 * j + m] * sigma[m, step] * takes[6 * k + step]
    for j in range(9):
        total[j] = scan[j] + noise * inverse[j]
    for j in range(3):
        of_map = mapped if j == 0 else tilted + other * whole * inverse[4 * j]
        apart = scan[4 * j] + of_map - 2.0 * common * sqrt(max(scan[4 * j] * of_map, 0.0))
        total[4 * j] += max(scan[4 * j], max(of_map, apart)) - scan[4 * j]
    total[0] += floor
    unsure = noise * inverse[0]
    inverse_symmetric(total, inverse)
    square = 0.0
    for j in range(3):
        for k in range(3):
            square += theta[j] * inverse[3 * j + k] * theta[k]
    for j in range(9):
        total[j] += beyond * scan[j]
    inverse_symmetric(total, inverse)
    along_x = along_y = 0.0
    for j in range(3):
        off = beyond * (
            inverse[3 * j] * theta[0]
            + inverse[3 * j + 1] * theta[1]
            + inverse[3 * j + 2] * theta[2]
        )
        for m in range(6):
            along_x -= sigma[4, m] * takes[6 * j + m] * off
            along_y += sigma[3, m] * takes[6 * j + m] * off
    return Departure(
        share=share,
        height=theta[0],
        tilt=(along_x, along_y),
        centre=(x0, y0),
        claimed=scan[0],
        mapped=mapped,
        noise=unsure,
        deviations=sqrt(max(square, 0.0)),
    )
