# SPDX-License-Identifier: Apache-2.0
"""Fit of a plane to the points of one scan in one cell (paper IV.A).

Each scan has its own offset in a cell (Eq. 20, Eq. 21): only the relative positions of its points
determine the slope. Pose error is common to them and has its own part of the covariance.
"""

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.libc.math import fabs, sqrt
from cython.cimports.quadtree_lss.onboard.core.geometry import plane
from cython.cimports.quadtree_lss.onboard.core.geometry.morton import compact, encode
from cython.cimports.quadtree_lss.onboard.core.geometry.sphere import basis_at
from cython.cimports.quadtree_lss.onboard.core.tree.leaves import ESTIMATED, LIFT, UNKNOWN, WEIGHT

from quadtree_lss.onboard.arrays import Array, Index
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.geometry.sphere import Vector
from quadtree_lss.onboard.core.sensing import lidar
from quadtree_lss.onboard.core.tree.leaves import LeafTable, Record

#: Lower bound of |n.u| (grazing incidence).
MIN_COSINE = cython.declare(cython.double, 0.05)
MAX_VARIANCE = cython.declare(cython.double, lidar.MAX_VARIANCE)
#: Below this ratio of the n_z of an orthogonal fit and of the regression of height, points are as
#: far apart in height as in place and are not a plane; the regression is used.
OVERTURNED = cython.declare(cython.double, 0.5)
#: A view is partial if it leaves at least this share of the cell's width unobserved.
PARTIAL = cython.declare(cython.double, 0.5)
#: Lift of a strip that is as thin as noise, see `_bias`.
TAIL = cython.declare(cython.double, 12.0)
#: Share of the turn by noise along the ray that also acts across it: the edges of the observed area
#: differ from those of its moments.
ACROSS = cython.declare(cython.double, 0.1)
#: A view is a line if noise along the ray may be this share of its smaller variance, and if that
#: variance is below this share of the cell's area (1 / 12 for a full cell).
LINE_NOISE = cython.declare(cython.double, 0.3)
LINE_WIDTH = cython.declare(cython.double, 1.0 / 48.0)
#: Standard deviation of an unknown slope, rad.
UNKNOWN_TILT = cython.declare(cython.double, 10.0)
#: Standard deviation of the slope difference between a cell and its observed part, rad.
UNOBSERVED_TILT = cython.declare(cython.double, 0.1)
#: Exceptions, in measurements, that divide a leaf: more than one stray return. They also find pits
#: (0.6 m wide and deep).
ROCK_EXCEPTIONS = 1.5
#: Points of one scan for a first fit: a plane has three unknowns.
FIT_POINTS = cython.declare(cython.double, 3.0)
#: Share of the least hazard by which the mean of a finest cell's returns must rise to show a rock:
#: a rock as narrow as the cell is rarely centred, and pose errors spread its returns.
MOUND = 1.0 / 3.0
#: Greatest sigma of a feature, in widths of the cell; wider ones are the shape of the ground.
FEATURE_WIDTH = 0.3

#: Fit of a scan's points in a cell, about the lidar:
#:
#: - points: number; centroid, m, and scatter, m^2: `geometry.plane.moments`;
#: - normal, z: the fitted plane's upward unit normal and height at the cell's centre, m;
#: - cosine: |n.u|, u the ray to the centroid; variance: of a residual from range noise, m^2;
#: - square: mean square residual about the fit, m^2; statistic: of division;
#: - has_slope: 0 for a strip too thin to determine a slope, else 1; height_only: 1 for points that
#:   determine the height only, else 0; mean_variance: of their mean height from range noise, m^2;
#:   lever: (2) from (centre, z) to the mean along the tangent axes, m;
#: - unobserved: share of the cell's width without points, 0 .. 1;
#: - raised_limit: distance from the leaf's plane beyond which points are raised, m; max_residual:
#:   greatest distance, m; offset_limit: greatest plausible offset of the mean from that plane, m;
#:   common_share: share of the offset from pose and plane, not noise, 0 .. 1;
#: - range_part, pose_part: covariances (9) of (dphi, dd) about (centre, z); with height_only,
#:   range_part has the variance of dd only;
#: - bias: turn of the fit by noise along the ray, t t^T as xx, xy, yy, rad^2, its lift (`LIFT`), m,
#:   and the weight of its slope (`WEIGHT`), m^2 (`_bias`).
NUMBERS = "z cosine variance square statistic unobserved has_slope height_only mean_variance"
NUMBERS += " raised_limit offset_limit max_residual common_share"
RUN = np.dtype(
    [("points", "f8"), ("centroid", "f8", 3), ("scatter", "f8", 6), ("normal", "f8", 3)]
    + [(name, "f8") for name in NUMBERS.split()]
    + [("lever", "f8", 2), ("range_part", "f8", 9), ("pose_part", "f8", 9), ("bias", "f8", 5)]
)


class Rules:
    """Parameters of the mapping kernels, from a configuration."""

    def __init__(self, config: Config) -> None:
        mapping, lengths = config.mapping, config.vehicle.lengths
        self.range_noise = config.lidar.range_noise
        self.stereo = config.lidar.stereo_noise
        self.ml = mapping.by_paper("fit")
        self.independent = mapping.by_paper("covariance")
        self.mahalanobis = mapping.by_paper("division")
        self.division_factor = mapping.division_factor
        self.divide_exceptions = ROCK_EXCEPTIONS
        self.rock_area = lengths.rock_area
        self.mound_height = MOUND * lengths.least_hazard
        self.correlation_time = config.pose.correlation_time
        self.uneven, self.slack = lengths.uneven, lengths.slack
        self.clip = lengths.clip
        self.tolerance = lengths.tolerance
        self.feature_height = lengths.feature_height
        self.feature_volume = lengths.feature_volume
        self.feature_width = FEATURE_WIDTH
        self.rock_height = max(lengths.rock_height, 3.0 * self.range_noise)
        self.rock_sigma = lengths.rock_sigma


def is_partial(run: Record) -> cython.bint:
    """Return whether a run covers less than half of its cell's width: a partial view."""
    return run.unobserved >= PARTIAL


def has_few_points(run: Record) -> cython.bint:
    """Return whether a run has at most three points, so that its own fit has no residuals."""
    return run.points <= 3.0


def pose_variance(normal: Vector, arm: Vector, sigma: Vector) -> cython.double:
    """Return the variance of n.r from pose error ``sigma`` (36) at a point ``arm`` (3) from the
    lidar, m^2 (Eq. 17)."""
    row = cython.declare(cython.double[6])
    cython.declare(i=cython.int, j=cython.int)
    for i in range(3):
        row[i] = normal[i]
    row[3] = arm[1] * normal[2] - arm[2] * normal[1]
    row[4] = arm[2] * normal[0] - arm[0] * normal[2]
    row[5] = arm[0] * normal[1] - arm[1] * normal[0]
    total = 0.0
    for i in range(6):
        for j in range(6):
            total += row[i] * sigma[6 * i + j] * row[j]
    return min(max(total, 0.0), MAX_VARIANCE)


def range_noise(
    rules: Rules, centroid: Vector, distance: float, boresight: Vector
) -> cython.double:
    """Return the standard deviation of ranges at a place (3) about the lidar, ``distance`` m away,
    m. The depth z of a stereo camera has the error c z^2, its range r that times r / z."""
    noise = rules.range_noise
    if rules.stereo > 0.0:
        depth = boresight[0] * centroid[0] + boresight[1] * centroid[1]
        depth = rules.stereo * distance * (depth + boresight[2] * centroid[2])
        noise = sqrt(noise * noise + depth * depth)
    return noise


def _unobserved_width(square: float, correlation: float, side: float) -> cython.double:
    """Return the width of a cell, along one of its axes, without points, m: those of variance
    ``square`` fill sqrt(3 square) on both sides of their mean, a diagonal band if correlated."""
    return side - 2.0 * sqrt(max(3.0 * square * (1.0 - correlation), 0.0))


def _bias(
    run: Record, ray_x: float, ray_y: float, deviation: float, lean: float, sloped: cython.bint
) -> None:
    """Compute the turn and lift of a fit by range noise that scans from one side do not average
    out.

    Noise e along the ray u moves the height of a point over the plane by e (n.u) / n_z and its
    place by e (u_x, u_y). Regression of height on place then has the error A^-1 q, with the
    covariance A of the points' x and y and q = var(e) (n.u) / n_z (u_x, u_y). At edges of the cell,
    unlike those of the scan, points that noise moves across them cancel it: all of it is used if
    half of the cell's width is unobserved, half of it if none is.

    An edge on one side lifts the mean by r = sqrt(var(e)) |(u_x, u_y)| / w standard deviations of
    height, w the width of the observed area along the ray; `TAIL` r^2, at most four standard
    deviations, accounts for strips that consist of noise. ``deviation``: sqrt(var(e)), m.
    ``lean``: |n.u| / n_z. ``sloped``: a slope was fitted.
    """
    share = 0.5 + min(run.unobserved, 0.5)
    per = 1.0 / run.points
    xx = run.scatter[0] * per
    xy = run.scatter[1] * per
    yy = run.scatter[3] * per
    # A strip has no width beyond what noise gives it, and is not taken for thinner.
    least = 0.01 * deviation * deviation
    flat = ray_x * ray_x + ray_y * ray_y
    along = ray_x * ray_x * xx + 2.0 * ray_x * ray_y * xy + ray_y * ray_y * yy
    # Of a vertical ray, or nearly, it is 0.
    thin = deviation * flat / sqrt(max(12.0 * along + least * flat, 1e-300))
    run.bias[0] = run.bias[1] = run.bias[2] = run.bias[WEIGHT] = 0.0
    run.bias[LIFT] = share * lean * deviation * min(thin + TAIL * thin * thin, 4.0)
    if sloped:
        xx += least
        yy += least
        inverse = share * deviation * deviation * lean / max(xx * yy - xy * xy, least * least)
        turn_x = inverse * (yy * ray_x - xy * ray_y)
        turn_y = inverse * (xx * ray_y - xy * ray_x)
        run.bias[0] = turn_x * turn_x + ACROSS * turn_y * turn_y
        run.bias[1] = (1.0 - ACROSS) * turn_x * turn_y
        run.bias[2] = turn_y * turn_y + ACROSS * turn_x * turn_x
        # A fit counts by the lesser spread of its points:
        # lambda_1 lambda_2 / (lambda_1 + lambda_2).
        run.bias[WEIGHT] = run.points * max(xx * yy - xy * xy, 0.0) / (xx + yy)


def measure(
    rules: Rules,
    leaf: Record,
    run: Record,
    points: Vector,
    number: cython.Py_ssize_t,
    pose: Record,
    side: float,
) -> None:
    """Fit a plane to a run of points in a leaf and write it to ``run``, without the division
    statistic.

    - A partial view that is too thin for a slope known to `UNOBSERVED_TILT` determines the height
      only, and keeps the previous slope: range noise would turn the fit towards the ray.
    - Other points on a line determine the slope along it (`line_normal`). Their variance is at
      least that of level ground, because a plane turned towards the ray would have exact points.
    - Misfit beyond noise adds to the variance of height and slope, because it does not average out.
      With too few points for an estimate, the leaf's ``parent_misfit`` is used.
    - The unobserved part may differ in slope by `UNOBSERVED_TILT`.

    ``points`` (3 ``number``) are about the lidar, ``pose`` is that of the scan, ``side`` that of
    the cell, m.
    """
    basis = cython.declare(cython.double[6])
    slope = cython.declare(cython.double[4])
    arm = cython.declare(cython.double[3])
    scatter = cython.declare(cython.double[6])
    cython.declare(i=cython.int, line=cython.bint)
    plane.moments(points, number, run.centroid, run.scatter)
    prior = leaf.normal
    x, y = leaf.x - pose.origin[0], leaf.y - pose.origin[1]
    count: cython.double = number
    run.points = count
    xx = run.scatter[0]
    yy = run.scatter[3]
    xy = run.scatter[1]
    off_x = run.centroid[0] - x
    off_y = run.centroid[1] - y
    # Variances of the points along the longer and the thinner width of what was seen: half + root
    # and half - root.
    run.unobserved = half = root = 0.0
    if count > 1.0:
        correlation = xy * xy / max(xx * yy, 1e-300)
        wide = max(
            _unobserved_width(xx / count, correlation, side),
            _unobserved_width(yy / count, correlation, side),
        )
        # What a full cell leaves out by chance does not count.
        run.unobserved = min(max(wide / side - 1.0 / sqrt(count), 0.0), 1.0)
        half = 0.5 * (xx + yy) / count
        root = sqrt(max(half * half - (xx * yy - xy * xy) / (count * count), 0.0))
    distance = sqrt(
        run.centroid[0] * run.centroid[0]
        + run.centroid[1] * run.centroid[1]
        + run.centroid[2] * run.centroid[2]
    )
    if distance == 0.0:  # all around the lidar: no ray leads there
        run.centroid[2] = -1e-9
        distance = 1e-9
    ray_x = run.centroid[0] / distance
    ray_y = run.centroid[1] / distance
    ray_z = run.centroid[2] / distance
    run.has_slope = 1.0
    run.height_only = 0.0
    noise = range_noise(rules, run.centroid, distance, pose.boresight)
    least = max(half - root, 1e-12)
    square = noise * noise
    line = False
    if is_partial(run):
        # The slope across the thinner width: of noise, and of what that turns it by.
        if sqrt(square / (count * least)) + 0.5 * square / least > UNOBSERVED_TILT:
            run.has_slope = 0.0
    else:
        level = ray_x * ray_x + ray_y * ray_y
        line = square * level > LINE_NOISE * least and least < LINE_WIDTH * side * side
        line = line and square * level < LINE_NOISE * (half + root)
    telling = run.scatter  # for the covariance; of a line, the part along it
    if run.has_slope == 0.0 or (count < FIT_POINTS and not line):
        run.height_only = 1.0
        for i in range(3):
            run.normal[i] = prior[i]
    elif line:
        telling = scatter
        plane.line_normal(run.scatter, prior, count * (half + root), square, run.normal, telling)
    else:
        plane.height_normal(
            run.scatter, -prior[0] / prior[2], -prior[1] / prior[2], square, run.normal
        )
        if rules.ml and count > 3.0:
            first, second, up = run.normal[0], run.normal[1], run.normal[2]
            plane.orthogonal_normal(run.scatter, run.normal)
            if run.normal[2] < OVERTURNED * up:
                run.normal[0], run.normal[1], run.normal[2] = first, second, up
    # Computed early: reading two fresh stores as one vector stalls (store forwarding).
    basis_at(run.normal, basis)
    up = run.normal[2]
    cosine = fabs(run.normal[0] * ray_x + run.normal[1] * ray_y + up * ray_z)
    cosine = max(cosine, MIN_COSINE)
    if line or count < FIT_POINTS:
        cosine = max(cosine, -ray_z)
    along = noise * noise  # Eq. 13
    run.cosine = cosine
    run.variance = variance = along * cosine * cosine
    if rules.independent:
        variance += pose_variance(run.normal, run.centroid, pose.sigma)
    rise = (run.normal[0] * off_x + run.normal[1] * off_y) / up
    run.z = run.centroid[2] + rise
    arm[0], arm[1], arm[2] = x, y, run.z
    run.square = misfit = 0.0
    if count > 1.0:
        quadratic = (
            run.normal[0] * (run.normal[0] * xx + 2.0 * run.normal[1] * xy)
            + run.normal[1] * run.normal[1] * yy
            + up * up * run.scatter[5]
            + 2.0 * up * run.normal[0] * run.scatter[2]
            + 2.0 * up * run.normal[1] * run.scatter[4]
        )
        free = max(count - 3.0, 1.0)
        run.square = max(quadratic, 0.0) / free
        # Upper limit of what noise explains.
        most = run.variance * (1.0 + 2.0 * sqrt(2.0 / free))
        misfit = max(run.square - most, 0.0)
    # A plane that noise turned towards the ray has a noise of height, too.
    lean = max(cosine / up, -ray_z)
    _bias(run, ray_x, ray_y, noise, lean, run.height_only == 0.0 and not line)
    if run.has_slope == 0.0 and leaf.state != UNKNOWN:
        # In a strip as wide as the noise, errors of place and height are correlated along the ray
        # u: a range error e lifts the plane by e (n.u) / n_z, a height of -e cosine / up. The ray
        # is exact, so the place, off - e u, is where it meets the known plane.
        gap = run.z - (leaf.z - pose.origin[2])
        most = 3.0 * sqrt(variance / count) / up
        gap = min(max(gap, -most), most) * up / cosine
        off_x += gap * ray_x
        off_y += gap * ray_y
        rise = (run.normal[0] * off_x + run.normal[1] * off_y) / up
    run.mean_variance = variance / count + misfit
    run.lever[0] = first = basis[0] * off_x + basis[1] * off_y - basis[2] * rise
    run.lever[1] = second = basis[3] * off_x + basis[4] * off_y - basis[5] * rise
    if run.height_only > 0.0:
        flat = first * first + second * second
        run.range_part[8] = run.mean_variance + UNKNOWN_TILT * UNKNOWN_TILT * flat
    else:
        plane.slope_covariance(
            telling, run.normal, variance + max(misfit, leaf.parent_misfit), slope
        )
        if not line:
            tilt = run.unobserved * UNOBSERVED_TILT
            slope[0] += tilt * tilt
            slope[3] += tilt * tilt
        plane.covariance_about(slope, run.mean_variance, first, second, run.range_part)
    if rules.independent:
        for i in range(9):
            run.pose_part[i] = 0.0
    else:
        plane.pose_part(run.normal, basis, arm, pose.sigma, run.pose_part)
    run.statistic = run.max_residual = run.raised_limit = run.offset_limit = 0.0
    run.common_share = 1.0


@cython.boundscheck(False)
def unobserved_parts(table: LeafTable, rows: Index, out: Array) -> None:
    """Set what the unobserved parts of leaves (M,) and the bias from noise along the rays add to
    their covariance (M, 9) of (dphi, dd).

    The slope may differ there by `UNOBSERVED_TILT` and by the parent's misfit: a tilt about the
    mean of the observed finest cells, in proportion to the unobserved share of the width.
    """
    basis = cython.declare(cython.double[6])
    slope = cython.declare(cython.double[4])
    cython.declare(i=cython.Py_ssize_t, k=cython.Py_ssize_t, down=cython.int)
    cython.declare(first=cython.Py_ssize_t, number=cython.Py_ssize_t, seen=cython.Py_ssize_t)
    observed = table.seen
    with cython.nogil:
        for i in range(rows.shape[0]):
            table.prefetch_leaf(rows[min(i + 4, rows.shape[0] - 1)])
            leaf = table.at(rows[i])
            slope[0] = leaf.bias[0]
            slope[1] = slope[2] = leaf.bias[1]
            slope[3] = leaf.bias[2]
            lift = leaf.bias[LIFT] * leaf.bias[LIFT]
            part = cython.address(out[i, 0])
            down = 2 * (table.max_level - leaf.level)
            number = 1 << down
            first = encode(leaf.ix, leaf.iy) << down
            seen = 0
            for k in range(first, first + number):
                seen += 1 if observed[k] else 0
            if seen == 0 or seen == number or leaf.state != ESTIMATED:
                plane.covariance_about(slope, lift, 0.0, 0.0, part)
                continue
            sx = sy = sxx = sxy = syy = 0.0
            for k in range(number):
                if observed[first + k]:
                    x = compact(k) + 0.5
                    y = compact(k >> 1) + 0.5
                    sx += x
                    sy += y
                    sxx += x * x
                    sxy += x * y
                    syy += y * y
            x = sx / seen
            y = sy / seen
            # Bessel's correction; each cell is a square of side one.
            free = max(seen - 1.0, 1.0)
            sxx = (sxx - seen * x * x) / free + 1.0 / 12.0
            syy = (syy - seen * y * y) / free + 1.0 / 12.0
            sxy = (sxy - seen * x * y) / free
            across = sqrt(number)
            correlation = sxy * sxy / (sxx * syy)
            wide = max(
                _unobserved_width(sxx, correlation, across),
                _unobserved_width(syy, correlation, across),
            )
            wide = min(max(wide / across, 0.0), 1.0)
            side = table.sides[leaf.level]
            tilt = UNOBSERVED_TILT * UNOBSERVED_TILT + 12.0 * leaf.parent_misfit / (side * side)
            tilt *= wide * wide
            slope[0] += tilt
            slope[3] += tilt
            side /= across
            x = side * (x - 0.5 * across)
            y = side * (y - 0.5 * across)
            z = -(leaf.normal[0] * x + leaf.normal[1] * y)
            z /= leaf.normal[2]
            basis_at(leaf.normal, basis)
            along = basis[0] * x + basis[1] * y + basis[2] * z
            across = basis[3] * x + basis[4] * y + basis[5] * z
            plane.covariance_about(slope, lift, along, across, part)
