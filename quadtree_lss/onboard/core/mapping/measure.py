# SPDX-License-Identifier: Apache-2.0
"""What the points of one scan in one cell say of its plane (paper IV.A).

Each scan has its own offset there (Eq. 20, Eq. 21): only how its points lie to one another tells
the slope, and pose error, which is theirs in common, is a part of the covariance by itself.
"""

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.libc.math import fabs, sqrt
from cython.cimports.quadtree_lss.onboard.core.geometry import plane
from cython.cimports.quadtree_lss.onboard.core.geometry.morton import encode, squeeze
from cython.cimports.quadtree_lss.onboard.core.geometry.sphere import basis_at
from cython.cimports.quadtree_lss.onboard.core.tree.leaves import LIFT, NOTHING, WEIGHT

from quadtree_lss.onboard.arrays import Array, Index
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.geometry.sphere import Vector
from quadtree_lss.onboard.core.sensing import lidar
from quadtree_lss.onboard.core.tree.leaves import LeafTable, Record

#: |n.u| is taken to be at least this (grazing incidence).
MIN_COSINE = cython.declare(cython.double, 0.05)
MAX_VARIANCE = cython.declare(cython.double, lidar.MAX_VARIANCE)
#: An orthogonal fit that stands so much steeper than the regression of height (n_z over n_z) is of
#: points that are as far apart in height as in place: no plane.
OVERTURNED = cython.declare(cython.double, 0.5)
#: A view that leaves out more than this share of a cell's width does not stand for the cell.
PARTIAL = cython.declare(cython.double, 0.5)
#: How a strip as thin as noise may be lifted: see `_bias`.
TAIL = cython.declare(cython.double, 12.0)
#: Of the variance by which noise along the ray may turn a fit, so much across that: the edges of
#: what was seen lie otherwise than its moments say.
ACROSS = cython.declare(cython.double, 0.1)
#: A view is a line where noise along the ray may make so much of its thinner variance, and that is
#: below such a share of the cell's square (a full cell's is 1 / 12).
LINE_NOISE = cython.declare(cython.double, 0.3)
LINE_WIDTH = cython.declare(cython.double, 1.0 / 48.0)
#: What is not known of a slope, rad.
UNKNOWN_TILT = cython.declare(cython.double, 10.0)
#: By how much a cell's slope may differ from that of the part of it which was seen, rad.
UNSEEN_TILT = cython.declare(cython.double, 0.1)
#: By how many standard deviations the mean of a cell's misfit must exceed the threshold (Eq. 47).
CONFIDENCE = 0.5
#: Free residuals (points less three a scan) before this mean counts.
LEAST_RESIDUALS = 8.0
#: Exceptions, in measurements, that show a rock and divide a leaf: more than one stray return. They
#: find what rises nowhere: a pit 0.6 m wide and deep.
ROCK_EXCEPTIONS = 1.5
#: Points of one scan that make a first fit: a plane has as many unknowns.
FIT_POINTS = 3.0
#: Share of the least hazard by which the mean of a finest cell's returns rises where a rock is: one
#: as narrow as the cell is seldom in its middle, and poses spread its returns over the neighbours.
MOUND = 1.0 / 3.0
#: What a parent's slope is worth to a child, in points that fill it. With half as many, 46 and not
#: 52 % of the safe ground was kept under much noise, at as many hazards found.
SLOPE_POINTS = 10.0
#: A wider feature (sigma), in widths of the cell, is the form of the ground.
FEATURE_WIDTH = 0.3
#: Points of one scan that a feature takes, for its five numbers.
FEATURE_POINTS = 12.0

#: The points of a scan in a cell, about the lidar:
#:
#: - points: how many; centroid, m, and scatter, m^2: `geometry.plane.moments`;
#: - normal, z: the fitted plane's upward unit normal and height at the cell's centre, m;
#: - cosine: |n.u|, u the ray to the centroid; variance: of a residual from range noise, m^2;
#: - square: mean square residual about the fit, m^2; statistic: of division;
#: - sloped: 0 of a strip too thin to tell a slope, else 1; alone: 1 of points that tell their
#:   height alone, else 0; own: variance of their mean from range noise, m^2; lever: (2) from
#:   (centre, z) to it, along the tangent axes, m;
#: - unseen: share of the cell's width that the points leave out, 0 .. 1;
#: - raised_by: from which distance to the leaf's plane on points stand out, m; greatest: of them,
#:   m; doubt: how far the run's mean may lie off that plane and both be right, m; shared: of that,
#:   what its points have in common by pose and plane, and not by noise, 0 .. 1;
#: - range_part, pose_part: covariances (9) of (dphi, dd) about (centre, z); of points that tell
#:   their height alone, range_part has the variance of dd and no other;
#: - bias: what noise along the ray may turn the fit by, t t^T as xx, xy, yy, rad^2, and lift it by
#:   (`LIFT`), m, and how much the slope of the fit counts (`WEIGHT`), m^2 (`_bias`).
RUN = np.dtype(
    [("points", "f8"), ("centroid", "f8", 3), ("scatter", "f8", 6), ("normal", "f8", 3)]
    + [(name, "f8") for name in ("z", "cosine", "variance", "square", "statistic", "unseen")]
    + [(name, "f8") for name in ("sloped", "alone", "own", "raised_by", "doubt", "greatest")]
    + [("shared", "f8"), ("lever", "f8", 2), ("range_part", "f8", 9), ("pose_part", "f8", 9)]
    + [("bias", "f8", 5)]
)


class Rules:
    """The numbers of a configuration that the kernels of mapping go by."""

    def __init__(self, config: Config) -> None:
        mapping, lengths = config.mapping, config.vehicle.lengths
        self.range_noise = config.lidar.range_noise
        self.stereo = config.lidar.stereo_noise
        self.look(np.zeros(3))
        self.ml = mapping.by_paper("fit")
        self.independent = mapping.by_paper("covariance")
        self.mahalanobis = mapping.by_paper("division")
        self.division_factor = mapping.division_factor
        self.division_confidence = CONFIDENCE
        self.min_residuals = LEAST_RESIDUALS
        self.divide_exceptions = ROCK_EXCEPTIONS
        self.rock_area = lengths.rock_area
        self.mound_height = MOUND * lengths.least_hazard
        self.min_points = FIT_POINTS
        self.slope_points = SLOPE_POINTS
        self.correlation_time = config.pose.correlation_time
        self.uneven, self.slack = lengths.uneven, lengths.slack
        self.clip = lengths.clip
        self.tolerance = lengths.tolerance
        self.feature_height = lengths.feature_height
        self.feature_volume = lengths.feature_volume
        self.feature_width = FEATURE_WIDTH
        self.feature_points = FEATURE_POINTS
        self.rock_height = max(lengths.rock_height, 3.0 * self.range_noise)
        self.rock_sigma = lengths.rock_sigma

    def look(self, boresight: Array) -> None:
        """Take over the boresight of the next scan, a unit vector (3,) in map axes: the noise of a
        depth camera depends on it."""
        self.ahead_x, self.ahead_y, self.ahead_z = boresight.tolist()


def partial(run: Record) -> cython.bint:
    """Whether a run shows less than half of its cell's width, and does not stand for the cell."""
    return run.unseen >= PARTIAL


def few(run: Record) -> cython.bint:
    """Whether a plane goes through all points of a run: they do not test a fit of their own."""
    return run.points <= 3.0


def pose_variance(normal: Vector, arm: Vector, sigma: Vector) -> cython.double:
    """Variance that pose error, ``sigma`` (36), gives n.r at a point ``arm`` (3) from the lidar,
    m^2 (Eq. 17)."""
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


def range_noise(rules: Rules, centroid: Vector, distance: float) -> cython.double:
    """Deviation of ranges at a place (3) about the lidar, so many m away, but for what grows with
    range, m. The depth z of a stereo camera errs by c z^2, its range r by as much times r / z."""
    noise = rules.range_noise
    if rules.stereo > 0.0:
        depth = rules.ahead_x * centroid[0] + rules.ahead_y * centroid[1]
        depth = rules.stereo * distance * (depth + rules.ahead_z * centroid[2])
        noise = sqrt(noise * noise + depth * depth)
    return noise


def _unseen(square: float, correlation: float, side: float) -> cython.double:
    """Width of a cell, along one of its axes, that points leave out, m.

    Points of variance ``square`` fill sqrt(3 square) to either side of their mean; correlated with
    the other axis, they fill a diagonal band only.
    """
    return side - 2.0 * sqrt(max(3.0 * square * (1.0 - correlation), 0.0))


def _bias(
    run: Record, ray_x: float, ray_y: float, deviation: float, lean: float, sloped: cython.bint
) -> None:
    """What range noise may turn a fit by, and lift it, that scans from one side do not average out.

    Noise e moves a point along the ray u, in height over the plane by e (n.u) / n_z and in place by
    e (u_x, u_y). Regression of height on place then errs by A^-1 q, A the covariance of the points'
    x and y, q = var(e) (n.u) / n_z (u_x, u_y), where all edges of what was seen are edges of the
    scan. Where the ground goes on they are the cell's, and points that noise moves over them, one
    way and the other, take that away; where they are both, half is left. How much of the edges is
    which, a leaf does not know: all is taken where half of its width is unseen, half where none is.

    An edge on one side alone lifts the mean by r = sqrt(var(e)) |(u_x, u_y)| / w of a deviation
    in height, w the width of what was seen along the ray; a strip of less than four deviations may
    be nothing but what noise moved there: `TAIL` r^2 stands for that, four deviations at most.

    Args:
        run: Record of type `RUN`: points, scatter and unseen are read, the bias is written.
        ray_x, ray_y: Of u. deviation: sqrt(var(e)), m. lean: |n.u| / n_z.
        sloped: Whether the slope was fitted.
    """
    share = 0.5 + min(run.unseen, 0.5)
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
    origin: Vector,
    sigma: Vector,
    side: float,
) -> None:
    """Fit a plane to a run of points in a leaf; it is written to ``run``, without the statistic.

    Range noise moves points along the ray, in place as in height, and would turn the fit of a thin
    view towards it. A view of less than half of the cell, so thin that its slope is known no better
    than to `UNSEEN_TILT`, tells its height alone, and the slope is taken to be the one before: so
    is a strip at the edge of a scan. Other points on a line, and fewer than `FIT_POINTS`, tell the
    slope along it (`line_normal`); their variance is not that of a plane at a flatter angle than
    level ground, or a plane turned towards the ray would take its points for exact. Residuals
    beyond what noise makes of them are of ground that is no plane: as scans see it from elsewhere,
    its height is as uncertain, however many points there are, and its slope by as much more noise.
    Too few points to show it have as much more as the leaf's ``uneven`` says. What a view leaves
    out may differ in slope by `UNSEEN_TILT`.

    Args:
        leaf: Record of type `LEAF`, read: its normal is kept to where points do not tell the slope.
        run: Record of type `RUN`.
        points, number: Of the run (3 N), map axes about the lidar, m, and N.
        origin: (3) of the lidar, map frame, m.
        sigma: (36) pose covariance.
        side: Of the cell, m.
    """
    basis = cython.declare(cython.double[6])
    slope = cython.declare(cython.double[4])
    arm = cython.declare(cython.double[3])
    scatter = cython.declare(cython.double[6])
    cython.declare(i=cython.int, line=cython.bint)
    plane.moments(points, number, run.centroid, run.scatter)
    prior = leaf.normal
    x, y = leaf.x - origin[0], leaf.y - origin[1]
    count: cython.double = number
    run.points = count
    xx = run.scatter[0]
    yy = run.scatter[3]
    xy = run.scatter[1]
    off_x = run.centroid[0] - x
    off_y = run.centroid[1] - y
    # Variances of the points along the longer and the thinner width of what was seen: half + root
    # and half - root.
    run.unseen = half = root = 0.0
    if count > 1.0:
        correlation = xy * xy / max(xx * yy, 1e-300)
        wide = max(_unseen(xx / count, correlation, side), _unseen(yy / count, correlation, side))
        # What a full cell leaves out by chance does not count.
        run.unseen = min(max(wide / side - 1.0 / sqrt(count), 0.0), 1.0)
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
    run.sloped = 1.0
    run.alone = 0.0
    noise = range_noise(rules, run.centroid, distance)
    least = max(half - root, 1e-12)
    square = noise * noise
    line = False
    if partial(run):
        # The slope across the thinner width: of noise, and of what that turns it by.
        if sqrt(square / (count * least)) + 0.5 * square / least > UNSEEN_TILT:
            run.sloped = 0.0
    else:
        level = ray_x * ray_x + ray_y * ray_y
        line = square * level > LINE_NOISE * least and least < LINE_WIDTH * side * side
        line = line and square * level < LINE_NOISE * (half + root)
    telling = run.scatter  # for the covariance: all of it, but of a line
    if run.sloped == 0.0 or (count < rules.min_points and not line):
        run.alone = 1.0
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
            first = run.normal[0]
            second = run.normal[1]
            up = run.normal[2]
            plane.orthogonal_normal(run.scatter, run.normal)
            if run.normal[2] < OVERTURNED * up:
                run.normal[0] = first
                run.normal[1] = second
                run.normal[2] = up
    # Long before it is asked for: of what was just stored, a processor is slow to take two numbers.
    basis_at(run.normal, basis)
    up = run.normal[2]
    cosine = fabs(run.normal[0] * ray_x + run.normal[1] * ray_y + up * ray_z)
    cosine = max(cosine, MIN_COSINE)
    if line or count < rules.min_points:
        cosine = max(cosine, -ray_z)
    along = noise * noise  # Eq. 13
    run.cosine = cosine
    run.variance = variance = along * cosine * cosine
    if rules.independent:
        variance += pose_variance(run.normal, run.centroid, sigma)
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
        # Noise makes no more of it, mostly.
        most = run.variance * (1.0 + 2.0 * sqrt(2.0 / free))
        misfit = max(run.square - most, 0.0)
    # A plane that noise has turned towards the ray is not free of it.
    lean = max(cosine / up, -ray_z)
    _bias(run, ray_x, ray_y, noise, lean, run.alone == 0.0 and not line)
    if run.sloped == 0.0 and leaf.known != NOTHING:
        # Of a strip that is as wide as the noise, place and height err together, along the ray u:
        # a range off by e lifts the plane by e (n.u) / n_z, which is a height of -e cosine / up.
        # Rays are exact: the place, off - e u, is where the ray meets the plane that is known.
        gap = run.z - (leaf.z - origin[2])
        most = 3.0 * sqrt(variance / count) / up
        gap = min(max(gap, -most), most) * up / cosine
        off_x += gap * ray_x
        off_y += gap * ray_y
        rise = (run.normal[0] * off_x + run.normal[1] * off_y) / up
    run.own = variance / count + misfit
    run.lever[0] = first = basis[0] * off_x + basis[1] * off_y - basis[2] * rise
    run.lever[1] = second = basis[3] * off_x + basis[4] * off_y - basis[5] * rise
    if run.alone > 0.0:
        flat = first * first + second * second
        run.range_part[8] = run.own + UNKNOWN_TILT * UNKNOWN_TILT * flat
    else:
        plane.slope_covariance(telling, run.normal, variance + max(misfit, leaf.uneven), slope)
        if not line:
            tilt = run.unseen * UNSEEN_TILT
            slope[0] += tilt * tilt
            slope[3] += tilt * tilt
        plane.covariance_about(slope, run.own, first, second, run.range_part)
    if rules.independent:
        for i in range(9):
            run.pose_part[i] = 0.0
    else:
        plane.pose_part(run.normal, basis, arm, sigma, run.pose_part)
    run.statistic = run.greatest = run.raised_by = run.doubt = 0.0
    run.shared = 1.0


@cython.boundscheck(False)
def unseen_parts(table: LeafTable, rows: Index, out: Array) -> None:
    """What the parts of leaves (M,) that were never seen add to their covariance (M, 9) of (dphi,
    dd).

    However often a part is seen, it says nothing of the rest. The slope there may differ by
    `UNSEEN_TILT`, and by what its parent's plane left out: a tilt about the middle of the finest
    cells in which a point fell, by as much of the leaf's width as these leave out. Noise along the
    rays turned the plane about there, too.
    """
    basis = cython.declare(cython.double[6])
    slope = cython.declare(cython.double[4])
    part = cython.declare(cython.double[9])
    cython.declare(i=cython.Py_ssize_t, k=cython.Py_ssize_t, j=cython.int, first=cython.Py_ssize_t)
    cython.declare(number=cython.Py_ssize_t, seen=cython.Py_ssize_t)
    observed = table.seen
    with cython.nogil:
        for i in range(rows.shape[0]):
            table.expect(rows[min(i + 4, rows.shape[0] - 1)])
            leaf = table.at(rows[i])
            slope[0] = leaf.bias[0]
            slope[1] = slope[2] = leaf.bias[1]
            slope[3] = leaf.bias[2]
            lift = leaf.bias[LIFT] * leaf.bias[LIFT]
            j = 2 * (table.max_level - leaf.level)
            number = 1 << j
            first = encode(leaf.ix, leaf.iy) << j
            seen = 0
            for k in range(first, first + number):
                seen += 1 if observed[k] else 0
            if seen == 0 or seen == number or leaf.known < 3:
                plane.covariance_about(slope, lift, 0.0, 0.0, part)
                for j in range(9):
                    out[i, j] = part[j]
                continue
            sx = sy = sxx = sxy = syy = 0.0
            for k in range(number):
                if observed[first + k]:
                    x = squeeze(k) + 0.5
                    y = squeeze(k >> 1) + 0.5
                    sx += x
                    sy += y
                    sxx += x * x
                    sxy += x * y
                    syy += y * y
            x = sx / seen
            y = sy / seen
            # Of few, the mean lies nearer to them than to the ground; each is a square of side one.
            free = max(seen - 1.0, 1.0)
            sxx = (sxx - seen * x * x) / free + 1.0 / 12.0
            syy = (syy - seen * y * y) / free + 1.0 / 12.0
            sxy = (sxy - seen * x * y) / free
            across = sqrt(number)
            correlation = sxy * sxy / (sxx * syy)
            wide = max(_unseen(sxx, correlation, across), _unseen(syy, correlation, across))
            wide = min(max(wide / across, 0.0), 1.0)
            side = table.side(leaf.level)
            tilt = wide * wide * (UNSEEN_TILT * UNSEEN_TILT + 12.0 * leaf.uneven / (side * side))
            slope[0] += tilt
            slope[3] += tilt
            side /= across
            x = side * (x - 0.5 * across)
            y = side * (y - 0.5 * across)
            z = -(leaf.normal[0] * x + leaf.normal[1] * y)
            z /= leaf.normal[2]
            basis_at(leaf.normal, basis)
            plane.covariance_about(
                slope,
                lift,
                basis[0] * x + basis[1] * y + basis[2] * z,
                basis[3] * x + basis[4] * y + basis[5] * z,
                part,
            )
            for j in range(9):
                out[i, j] = part[j]
