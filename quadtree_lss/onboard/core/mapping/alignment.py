# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False
"""A scan against the map: their common motion, whether it is plausible, and the height offset.

Pose error moves all points of a scan at once. Eq. 20 has one offset for each scan and cell; a
common one is more precise and avoids steps between cells that different scans have observed.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import cython
import numpy as np
from cython.cimports.libc.math import INFINITY, exp, fabs, sqrt
from cython.cimports.quadtree_lss.onboard.core.geometry.plane import inverse_symmetric
from cython.cimports.quadtree_lss.onboard.core.mapping import update as row
from cython.cimports.quadtree_lss.onboard.core.tree.leaves import INCOMPLETE, LeafTable

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.geometry.bounds import MAX_MAP_HEIGHT

# Lengths are those of a vehicle with ``VehicleConfig.height`` 1 m, and scale with it.
#: Residuals beyond this many standard deviations get Huber's lower weight: one Gaussian cell in 22.
HUBER = cython.declare(cython.double, 2.0)
#: Iterations of the reweighting; weights then change by less than 1 %.
ITERATIONS = cython.declare(cython.int, 5)
#: Variance of a cell's height from terrain that planes smooth, m^2, for the test of a scan (with
#: less, sound scans over simulated cliffs are rejected) and for its offset.
SMOOTHED = cython.declare(cython.double, 0.01**2)
OFFSET_SMOOTHED = cython.declare(cython.double, 0.02**2)
#: Share of a scan's cells that may have the same error that no rigid motion explains: a quarter of
#: its width, squared. With 1/32 a sound scan over simulated cliffs is rejected.
CORRELATED_SHARE = cython.declare(cython.double, 1.0 / 16.0)
#: Cells observed within this time are of the same scans, s; shorter than a scan period.
INSTANT = cython.declare(cython.double, 1e-3)
#: Variance of a scan's height that more cells do not reduce: the common error of ranges, m^2.
FLOOR = 0.04**2
#: Variance of the height of an exact pose, m^2; avoids a division by zero.
EXACT = cython.declare(cython.double, 1e-9)
#: A pose may be off by this many times the claimed standard deviation.
POSE_EXCESS = cython.declare(cython.double, 5.0)
#: Cells needed for a motion of three degrees of freedom.
MIN_CELLS = 3
#: An offset of more standard deviations than this is a jump of the pose error.
JUMP_SIGMAS = 3.0
#: Least height by which the map is lifted, m; landing reassesses ground that moves.
MIN_LIFT = 5e-4
#: A scan is inconsistent if less than this share of its cells agrees with the map, or if its motion
#: exceeds so many standard deviations: of three degrees of freedom, one sound scan in 7,000 does.
AGREEING_SHARE = 1.0 / 3.0
MAX_SIGMAS = 4.5
#: A field of view narrower than the leaves touches at most so many of them.
NARROW_CELLS = 4
#: Consecutive, mutually consistent rejected scans that overrule the map.
OVERRULING_SCANS = 10


class RigidMotion(NamedTuple):
    """Rigid motion of a scan against the map.

    Attributes:
        share: Of the cells whose heights agree within both pose covariances, each by itself.
        height: Of the scan over the map at ``centre``, m.
        tilt: (2,) rise along x and y that the scan's attitude error explains if its pose is
            `POSE_EXCESS` times worse than claimed.
        centre: (2,) weighted mean of the agreeing cells, x and y about the lidar, m.
        claimed, mapped: Variance of ``height`` from the scan's and from the map's pose errors, m^2.
        noise: Variance of ``height`` from the noise of the cells, m^2.
        sigmas: Mahalanobis length of height and tilt; 0 with fewer than `MIN_CELLS` cells.
    """

    share: float
    height: float
    tilt: tuple[float, float]
    centre: tuple[float, float]
    claimed: float
    mapped: float
    noise: float
    sigmas: float


class Offset(NamedTuple):
    """Height of a scan over the map, m, and its variance, m^2. ``scan_part``: expected error of the
    scan, by which it is lowered; ``map_part``: that of the map, by which the map is lifted, m.
    ``since``: mean time of the first scan in the compared planes, s."""

    height: float
    scan_part: float
    map_part: float
    since: float
    variance: float


class Verdict(Enum):
    """Decision about a scan. OVERRULES: the map is lifted to the scan, or restarted if a lift does
    not make them consistent."""

    ACCEPTED = 0
    REJECTED = 1
    OVERRULES = 2


@dataclass
class RejectedScans:
    """Number of consecutive rejected scans that agree with each other, and the last one's median
    height over the map, m, with its variance from its own pose and noise, m^2."""

    count: int = 0
    height: float = 0.0
    variance: float = 0.0

    def decide(self, cells: Array, inconsistent: bool) -> Verdict:
        """Accept a scan, reject it, or let it overrule the map, by its cells of `ScanUpdate.fit` or
        `ScanUpdate.fit_finest`. Rejected scans agree if their heights differ by no more than their
        own poses claim."""
        if not inconsistent:
            self.count = 0
            return Verdict.ACCEPTED
        height = float(np.median(cells[row.RISE]))
        variance = float(np.median(cells[row.NOISE_VARIANCE] + cells[row.SCAN_VARIANCE]))
        allowed = MAX_SIGMAS**2 * (variance + self.variance)
        agrees = self.count > 0 and (height - self.height) ** 2 <= allowed
        self.count = self.count + 1 if agrees else 1
        self.height, self.variance = height, variance
        if self.count < OVERRULING_SCANS:
            return Verdict.REJECTED
        self.count = 0
        return Verdict.OVERRULES


def is_inconsistent(motion: RigidMotion | None) -> bool:
    """Return whether a scan contradicts the map: too few cells agree, or their common motion
    exceeds `MAX_SIGMAS`. Rocks, shadows and errors of the map affect a few cells only."""
    return motion is not None and (motion.share < AGREEING_SHARE or motion.sigmas > MAX_SIGMAS)


def is_inconsistent_narrow(finest: Array, length_unit: float) -> bool:
    """Return the same for a scan with too few leaves for a `RigidMotion`: whether less than
    `AGREEING_SHARE` of its explained finest cells, of `ScanUpdate.fit_finest`, agree."""
    height, own, scan_variance, map_variance = finest
    allowed = MAX_SIGMAS**2 * (own + scan_variance + map_variance + FLOOR * length_unit**2)
    count = len(height)
    agreeing = int(np.count_nonzero(height**2 <= allowed))
    return count >= MIN_CELLS and agreeing < AGREEING_SHARE * count


@cython.cfunc
@cython.exceptval(check=False)
@cython.locals(cells=cython.double[:, :], out=cython.p_double)
def _pose_jacobian(cells: Array, i: cython.Py_ssize_t, out: Array) -> cython.void:
    """J_i (6): derivative of the ground's height in a cell by the pose error (dm, dw)."""
    x, y, z = cells[row.PLACE_X, i], cells[row.PLACE_Y, i], cells[row.PLACE_Z, i]
    out[0] = -cells[row.SLOPE_X, i]
    out[1] = -cells[row.SLOPE_Y, i]
    out[2] = 1.0
    out[3] = y - z * out[1]
    out[4] = z * out[0] - x
    out[5] = x * out[1] - y * out[0]


@cython.cfunc
@cython.exceptval(check=False)
@cython.locals(cells=cython.double[:, :], kept=cython.Py_ssize_t[::1])
@cython.locals(work=cython.double[:, ::1], centre=cython.p_double)
def _agreeing_cells(
    cells: Array, length_unit: cython.double, kept: Array, work: Array, centre: Array
) -> cython.Py_ssize_t:
    """Select the cells that the poses explain, and return their number: columns ``kept``, standard
    deviation and weight in rows 0 and 1 of ``work``, weighted ``centre`` (2)."""
    i: cython.Py_ssize_t
    agreeing: cython.Py_ssize_t = 0
    limit: cython.double = MAX_SIGMAS * MAX_SIGMAS
    floor: cython.double = FLOOR * length_unit * length_unit
    smoothed: cython.double = SMOOTHED * length_unit * length_unit
    x = y = whole = 0.0
    for i in range(cells.shape[1]):
        own = cells[row.NOISE_VARIANCE, i]
        allowed = own + cells[row.SCAN_VARIANCE, i] + cells[row.MAP_VARIANCE, i] + floor
        if cells[row.RISE, i] * cells[row.RISE, i] <= limit * allowed:
            variance = own + smoothed
            w = 1.0 / variance
            whole += w
            x += w * cells[row.PLACE_X, i]
            y += w * cells[row.PLACE_Y, i]
            work[0, agreeing], work[1, agreeing], kept[agreeing] = sqrt(variance), w, i
            agreeing += 1
    if agreeing:
        centre[0], centre[1] = x / whole, y / whole
    return agreeing


@cython.cfunc
@cython.exceptval(check=False)
@cython.locals(cells=cython.double[:, :], kept=cython.Py_ssize_t[::1])
@cython.locals(work=cython.double[:, ::1], centre=cython.p_double, theta=cython.p_double)
@cython.locals(normal=cython.p_double, inverse=cython.p_double)
def _fit_motion(
    cells: Array,
    kept: Array,
    agreeing: cython.Py_ssize_t,
    work: Array,
    centre: Array,
    theta: Array,
    normal: Array,
    inverse: Array,
) -> cython.void:
    """Fit height and tilt ``theta`` (3) to the cells of `_agreeing_cells` by iteratively reweighted
    least squares. Row 2 of ``work``: the last of Huber's weights; ``normal``, ``inverse`` (9): A
    and A^-1 with them."""
    right = cython.declare(cython.double[3])
    cython.declare(i=cython.Py_ssize_t, j=cython.int, k=cython.Py_ssize_t, step=cython.int)
    theta[0] = theta[1] = theta[2] = 0.0
    for step in range(ITERATIONS + 1):
        for j in range(9):
            normal[j] = 0.0
        right[0] = right[1] = right[2] = 0.0
        for k in range(agreeing):
            i = kept[k]
            x, y = cells[row.PLACE_X, i] - centre[0], cells[row.PLACE_Y, i] - centre[1]
            off = fabs(cells[row.RISE, i] - theta[0] - theta[1] * x - theta[2] * y)
            w = work[1, k]
            if off > HUBER * work[0, k]:
                w *= HUBER * work[0, k] / off
            work[2, k] = w
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
        if step < ITERATIONS:  # the last iteration only updates the weights
            for j in range(3):
                theta[j] = 0.0
                for k in range(3):
                    theta[j] += inverse[3 * j + k] * right[k]


@cython.cfunc
@cython.exceptval(check=False)
@cython.locals(sigma=cython.double[:, ::1], gain=cython.p_double, inverse=cython.p_double)
@cython.locals(theta=cython.p_double, out=cython.p_double)
def _explained_tilt(
    sigma: Array, gain: Array, inverse: Array, theta: Array, out: Array
) -> cython.void:
    """Compute the rise along x and y, ``out`` (2), from the attitude error k^2 Sigma T^T (k^2 P +
    V)^-1 theta of a pose k = `POSE_EXCESS` times worse than claimed. ``gain``: T; ``inverse``:
    (k^2 P + V)^-1."""
    cython.declare(j=cython.int, m=cython.int)
    excess: cython.double = POSE_EXCESS * POSE_EXCESS
    out[0] = out[1] = 0.0
    for j in range(3):
        off = excess * (
            inverse[3 * j] * theta[0]
            + inverse[3 * j + 1] * theta[1]
            + inverse[3 * j + 2] * theta[2]
        )
        for m in range(6):
            out[0] -= sigma[4, m] * gain[6 * j + m] * off
            out[1] += sigma[3, m] * gain[6 * j + m] * off


@cython.locals(cells=cython.double[:, :], sigma=cython.double[:, ::1])
def rigid_motion(
    cells: Array, sigma: Array, now: float, correlation_time: float, length_unit: float = 1.0
) -> RigidMotion | None:
    """Estimate the rigid motion of a scan from cells (ROWS, M) of `ScanUpdate.fit` and test it;
    None with fewer than `MIN_CELLS`.

    The offsets b = X theta + noise, rows (1, r_i - r_0) of X, give theta = A^-1 X^T W b, height and
    tilt, A = X^T W X, with Huber's weights W over the cells' own variances plus `SMOOTHED`. Cells
    that neither pose explains (rocks, errors of the map) are left out (`_agreeing_cells`). If both
    poses are as good as they claim, theta has the covariance V, the sum of

    - P = T Sigma T^T, T = A^-1 X^T W J, from the scan's pose;
    - the map's, from the height variance M and the slope variance Q that its cells claim. Common
      error cancels: P_hh + M - 2 rho sqrt(P_hh M) remains, rho = exp(-dt / correlation_time), but
      at least the larger of both, because errors may be whiter than claimed. Tilts likewise; if
      different scans have observed the cells, M also tilts: Q + M / (mean square of r - r_0);
    - `FLOOR` for the height;
    - s^2 A^-1 from noise, s^2 = (sum of squares over v_i + 3) / max(N, 3) for the effective number
      N = (sum w)^2 / sum w^2 of cells, and max(s^2 - 1, 0) `CORRELATED_SHARE` N A^-1, so that rough
      or partly observed ground does not reject a scan.

    theta^T V^-1 theta is chi^2 with three degrees of freedom. ``sigma``: (6, 6) pose covariance.
    ``correlation_time``: of pose errors, s, 0 if they are white. ``length_unit``: scale of the
    constants of this module (``VehicleConfig.height``), m.
    """
    centre = cython.declare(cython.double[2])
    tilt = cython.declare(cython.double[2])
    theta = cython.declare(cython.double[3])
    normal = cython.declare(cython.double[9])
    inverse = cython.declare(cython.double[9])
    lift = cython.declare(cython.double[6])
    moved = cython.declare(cython.double[18])
    gain = cython.declare(cython.double[18])
    scan = cython.declare(cython.double[9])
    total = cython.declare(cython.double[9])
    cython.declare(i=cython.Py_ssize_t, j=cython.int, k=cython.int, m=cython.int, n=cython.int)
    count: cython.Py_ssize_t = cells.shape[1]
    excess: cython.double = POSE_EXCESS * POSE_EXCESS
    if count < MIN_CELLS:
        return None
    kept = cython.declare(cython.Py_ssize_t[::1], np.empty(count, dtype=np.intp))
    work = cython.declare(cython.double[:, ::1], np.empty((3, count)))
    agreeing: cython.Py_ssize_t = _agreeing_cells(cells, length_unit, kept, work, centre)
    share: cython.double = agreeing
    share /= count
    if agreeing < MIN_CELLS:
        return RigidMotion(share, 0.0, (0.0, 0.0), (0.0, 0.0), 0.0, 0.0, 0.0, 0.0)
    _fit_motion(cells, kept, agreeing, work, centre, theta, normal, inverse)
    square = weights = mapped = tilted = last = 0.0
    early, late = INFINITY, -INFINITY
    for j in range(18):
        moved[j] = 0.0
    for k in range(agreeing):
        i, w = kept[k], work[2, k]
        x, y = cells[row.PLACE_X, i] - centre[0], cells[row.PLACE_Y, i] - centre[1]
        off = cells[row.RISE, i] - theta[0] - theta[1] * x - theta[2] * y
        _pose_jacobian(cells, i, lift)
        for m in range(6):  # X^T W J
            moved[m] += w * lift[m]
            moved[6 + m] += w * x * lift[m]
            moved[12 + m] += w * y * lift[m]
        square += w * off * off
        weights += w * w
        mapped += w * cells[row.MAP_VARIANCE, i]
        tilted += w * cells[row.SLOPE_VARIANCE, i]
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
    effective = whole * whole / weights
    square = (square + 3.0) / max(effective, 3.0)
    noise = square + max(square - 1.0, 0.0) * CORRELATED_SHARE * effective
    for j in range(3):
        for k in range(6):
            gain[6 * j + k] = 0.0
            for m in range(3):
                gain[6 * j + k] += inverse[3 * j + m] * moved[6 * m + k]
    for j in range(3):
        for k in range(3):
            scan[3 * j + k] = 0.0
            for m in range(6):
                for n in range(6):
                    scan[3 * j + k] += gain[6 * j + m] * sigma[m, n] * gain[6 * k + n]
    for j in range(9):
        total[j] = scan[j] + noise * inverse[j]
    for j in range(3):
        by_scan = scan[4 * j]
        by_map = mapped if j == 0 else tilted + other * whole * inverse[4 * j]
        apart = by_scan + by_map - 2.0 * common * sqrt(max(by_scan * by_map, 0.0))
        total[4 * j] += max(by_scan, max(by_map, apart)) - by_scan
    total[0] += FLOOR * length_unit * length_unit
    height_noise = noise * inverse[0]
    inverse_symmetric(total, inverse)
    square = 0.0
    for j in range(3):
        for k in range(3):
            square += theta[j] * inverse[3 * j + k] * theta[k]
    for j in range(9):
        total[j] += excess * scan[j]
    inverse_symmetric(total, inverse)
    _explained_tilt(sigma, gain, inverse, theta, tilt)
    return RigidMotion(
        share=share,
        height=theta[0],
        tilt=(tilt[0], tilt[1]),
        centre=(centre[0], centre[1]),
        claimed=scan[0],
        mapped=mapped,
        noise=height_noise,
        sigmas=sqrt(max(square, 0.0)),
    )


def height_offset(
    cells: Array, now: float, correlation_time: float, length_unit: float = 1.0
) -> Offset | None:
    """Estimate the height offset of a scan and divide it between scan and map, or return None;
    arguments as of `rigid_motion`.

    The scan's planes are b above the map's: a mean with Huber's weights about the weighted median,
    of variance R. S and M are the variances that pose error gives the height of the scan and of the
    map's best known cell, times the share 1 - exp(-dt / correlation_time) that is not common. So
    S / (S + M + R) of b is the expected error of the scan and M / (S + M + R) that of the map.

    If b^2 > `JUMP_SIGMAS`^2 (S + M + R), the pose error jumped, and nothing of it is common. If
    n^2 = b^2 / max(S, M, R) exceeds `JUMP_SIGMAS`^2 as well and the map has several scans, the pose
    is worse than it claims: S counts (n / `JUMP_SIGMAS`)^6 times, at most `POSE_EXCESS`^2 times.
    """
    i: cython.Py_ssize_t
    column = cython.declare(cython.double[:, :], cells)
    count: cython.Py_ssize_t = column.shape[1]
    if count < MIN_CELLS:
        return None
    floor: cython.double = FLOOR * length_unit * length_unit
    model: cython.double = OFFSET_SMOOTHED * length_unit * length_unit
    exact: cython.double = EXACT * length_unit * length_unit
    jump: cython.double = JUMP_SIGMAS
    weights = np.empty(count)
    weight = cython.declare(cython.double[::1], weights)
    for i in range(count):
        weight[i] = 1.0 / (column[row.NOISE_VARIANCE, i] + model)
    middle: cython.double = weighted_median(cells[row.RISE], weights)
    total = height = scan_variance = since = until = 0.0
    least = INFINITY
    for i in range(count):
        away = fabs(column[row.RISE, i] - middle) * sqrt(weight[i])
        w = weight[i] * min(1.0, HUBER / max(away, HUBER))
        total += w
        height += w * column[row.RISE, i]
        scan_variance += w * column[row.SCAN_VARIANCE, i]
        since += w * column[row.FIRST_TIME, i]
        until += w * column[row.LAST_TIME, i]
        # Relative to the scan's, because on slopes sideways errors add to both.
        least = min(least, column[row.MAP_VARIANCE, i] / (column[row.SCAN_VARIANCE, i] + exact))
    height /= total
    scan_variance /= total
    since /= total
    until /= total
    map_variance = (scan_variance + exact) * least
    news = 1.0
    if correlation_time > 0.0:
        news -= exp(-fabs(now - until) / correlation_time)
    noise = 1.0 / total + floor
    if height * height > jump * jump * (news * (scan_variance + map_variance) + noise):
        news = 1.0
    scan_variance, map_variance = news * scan_variance, news * map_variance
    if until > since:
        excess = max(height * height / (jump * jump * max(scan_variance, map_variance, noise)), 1.0)
        scan_variance *= min(excess * excess * excess, POSE_EXCESS * POSE_EXCESS)
    share = height / (scan_variance + map_variance + noise)
    return Offset(height, share * scan_variance, share * map_variance, since, noise)


def weighted_median(values: Array, weights: Array) -> float:
    """Weighted median of values (N,), N at least 1."""
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


def remove_tilt(points: Array, motion: RigidMotion) -> None:
    """Tilt points (N, 3) about the lidar in place, m, so that the scan is parallel to the map."""
    # Rounded, as the offsets are, so that the order of the cells does not change the last bits.
    along_x, along_y, x, y = (round(value, 9) for value in (*motion.tilt, *motion.centre))
    points[:, 2] -= along_x * (points[:, 0] - x) + along_y * (points[:, 1] - y)


@cython.locals(table=LeafTable)
def lift_map(table: LeafTable, height: float, since: float) -> None:
    """Lift the leaves by ``height``, m, times the share of their scans from ``since`` (s) on, which
    are also in the compared ground."""
    row: cython.Py_ssize_t
    highest: cython.double = MAX_MAP_HEIGHT
    leaf = table.leaf
    for row in range(table.count):
        if leaf[row].state >= INCOMPLETE:
            first = leaf[row].first_time
            last = leaf[row].last_time
            shared = 1.0  # a leaf in which time stepped back
            if last >= first:
                shared = (last - max(first, since) + INSTANT) / (last - first + INSTANT)
            rise = height * min(max(shared, 0.0), 1.0)
            leaf[row].z += rise
            leaf[row].low += rise
            leaf[row].high += rise
            if not fabs(leaf[row].z) < highest:
                table.reset_leaf(table.at(row))
