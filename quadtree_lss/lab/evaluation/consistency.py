# SPDX-License-Identifier: Apache-2.0
"""Prefit residuals of a bag against the map's covariances (Table 2; Eq. 46, 61-63)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import chi

import quadtree_lss
from quadtree_lss.desk.replay.replay import scans
from quadtree_lss.desk.replay.results import aligned
from quadtree_lss.lab.evaluation.results import COLUMNS, EvaluationError, Results
from quadtree_lss.onboard.arrays import Array, Index
from quadtree_lss.onboard.config.settings import Config, LidarConfig
from quadtree_lss.onboard.core.geometry.morton import squeezed
from quadtree_lss.onboard.core.geometry.rotations import skew
from quadtree_lss.onboard.core.mapping.mapper import Mapper, ScanReport
from quadtree_lss.onboard.core.sensing.register import RegisteredScan, register
from quadtree_lss.onboard.core.tree.cell_map import CellMap

#: Probability of the acceptance interval (1 - alpha); the rest is split between both tails.
INSIDE = 0.95
#: Lower bound of variances, m^2.
FLOOR = 1e-12
#: Lower bound of |n.u|, at grazing incidence.
MIN_COSINE = 0.05


def acceptance_interval(degrees: int) -> tuple[float, float]:
    """Bounds of the central 95 % of the chi distribution of ``degrees`` (Eq. 62, Eq. 63)."""
    low, high = chi(degrees).interval(INSIDE)
    return float(low), float(high)


class Shares(NamedTuple):
    """Shares of residuals below and above the interval; NaN without residuals."""

    below: float
    above: float


@dataclass(frozen=True)
class Counts:
    """Residuals, and how many lie below and above the 95 % interval: of the test with one degree of
    freedom, and of the paper's with three."""

    points: int = 0
    below: int = 0
    above: int = 0
    below_3: int = 0
    above_3: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(*map(int.__add__, astuple(self), astuple(other)))

    @property
    def one_degree(self) -> Shares:
        """0.025 each if consistent."""
        return Shares(*(of / (self.points or np.nan) for of in (self.below, self.above)))

    @property
    def three_degrees(self) -> Shares:
        """Of the paper's test. The residual has one degree of freedom: most lie below."""
        return Shares(*(of / (self.points or np.nan) for of in (self.below_3, self.above_3)))


@dataclass(frozen=True)
class PrefitStatistics:
    """Residuals (N,) of the points of a scan in leaves with a measured plane: indices of
    points, rows of leaves, n.(r - c) - d and its standard deviation, m, and d_M (Eq. 46)."""

    point: Index
    row: Index
    residual: Array
    deviation: Array
    mahalanobis: Array

    @property
    def normalised(self) -> Array:
        """(N,) |residual| / deviation; of chi_1 if all covariances are right."""
        return np.abs(self.residual) / self.deviation

    def counts(self) -> Counts:
        outside = []
        for values, degrees in ((self.normalised, 1), (self.mahalanobis, 3)):
            low, high = acceptance_interval(degrees)
            outside += [int((values < low).sum()), int((values > high).sum())]
        return Counts(len(self.point), *outside)


def prefit_statistics(cells: CellMap, scan: RegisteredScan, lidar: LidarConfig) -> PrefitStatistics:
    """Residuals of a scan about the map ``cells`` from before the scan.

    e = n.(r - c) - d has the variance n^T Sigma_r n + a^T Sigma_P a with Sigma_r of Eq. 17 and
    a = (B^T (r - c), -1). Measured and predicted point lie on one ray u, so Eq. 61's residual is
    e u / (n.u), and its d_M (Eq. 46) is a multiple of |e|.
    """
    column, row = squeezed(scan.key)
    of_point = cells.leaf_raster()[row, column]
    point = np.flatnonzero(cells.measured[of_point])
    leaf = of_point[point].astype(np.intp)
    n, r = cells.normal[leaf], scan.points[point]
    arm = r - (np.column_stack([cells.x, cells.y, cells.z]) - scan.origin)[leaf]
    residual = _dot(n, arm)
    share = _dot(n[:, :2], arm[:, :2]) / (1.0 + n[:, 2]) + arm[:, 2]
    a = np.column_stack([arm[:, :2] - share[:, None] * n[:, :2], np.full(len(n), -1.0)])
    plane = np.einsum("ni,nij,nj->n", a, cells.covariance[leaf], a)
    distance = np.linalg.norm(r, axis=1)
    ray = r / distance[:, None]
    cosine = np.maximum(np.abs(_dot(n, ray)), MIN_COSINE)
    along = lidar.range_noise**2  # Eq. 13
    # Pose part of Eq. 17: J Sigma J^T with J = (I, -[r]_x).
    unit = np.broadcast_to(np.eye(3), (len(r), 3, 3))
    jacobian = np.concatenate([unit, -skew(r)], axis=-1)
    pose = jacobian @ scan.pose.covariance @ jacobian.transpose(0, 2, 1)
    variance = plane + along * cosine**2 + np.einsum("ni,nij,nj->n", n, pose, n)
    # The other variances act along the ray: only the pose part needs an inverse. A millionth of its
    # trace keeps it regular.
    trace = np.trace(pose, axis1=1, axis2=2)
    regular = pose + (1e-6 * trace + FLOOR)[:, None, None] * np.eye(3)
    weight = _dot(ray, np.linalg.solve(regular, ray[..., None])[..., 0])
    total = 1.0 / np.maximum(weight, 1e-300) + along + plane / cosine**2
    deviation = np.sqrt(np.maximum(variance, FLOOR))
    mahalanobis = np.abs(residual) / (cosine * np.sqrt(total))
    return PrefitStatistics(point, leaf, residual, deviation, mahalanobis)


def _dot(one: Array, other: Array) -> Array:
    """Dot products (N,) of vectors (N, k)."""
    return np.asarray(np.einsum("ni,ni->n", one, other))


@dataclass(frozen=True)
class Consistency:
    """Prefit residuals of a bag of so many mapped ``scans``."""

    counts: Counts
    scans: int

    def table(self) -> str:
        tests = ("one degree of freedom", "one_degree"), ("three (the paper)", "three_degrees")
        shares = [(title, getattr(self.counts, name)) for title, name in tests]
        rows = [(title, *(f"{v:.2%}" for v in (*of, sum(of)))) for title, of in shares]
        return "\n".join(aligned([("Prefit residuals", "below", "above", "both"), *rows]))


def consistency(
    bag: str | Path,
    config: Config,
    *,
    results: Results | None = None,
    scan_topic: str | None = None,
    pose_topic: str | None = None,
    progress: Callable[[int], None] | None = None,
) -> Consistency:
    """Map a bag as ``replay`` does; compare the points of each scan with the map before it.

    With ``results``, only their scans, which must be the same. ``progress`` gets the number of
    mapped scans. Raises `BagError`: the bag cannot be read or its topics are ambiguous;
    `EvaluationError`: no point fell on mapped ground, or the scans are not those of the results.
    """
    rows: dict[int, list[int]] = {}
    if results is not None:
        columns = (results.timing[name].tolist() for name in COLUMNS[:4])
        rows = {stamp: row for stamp, *row in zip(*columns, strict=True)}
    made_by = {} if results is None else results.summary.get("versions") or {}
    exact = made_by.get("quadtree_lss") == quadtree_lss.__version__
    landing = {} if results is None else results.summary.get("landing") or {}
    counts, number, mapper = Counts(), 0, Mapper(config)
    for scan in scans(bag, config, scan_topic=scan_topic, pose_topic=pose_topic):
        if rows and scan.stamp_ns not in rows:
            continue
        registered, _ = register(*scan[1:3], config.lidar, mapper.domain, scan.sweep)
        counts += prefit_statistics(mapper.snapshot(), registered, config.lidar).counts()
        mapper.look_at(landing.get("area"))
        report = mapper.update(scan.points_lidar, scan.pose, scan.sweep)
        if rows and not _same(report, *rows[report.stamp_ns], exact):
            points, used, leaves = rows[report.stamp_ns]
            raise EvaluationError(
                f"{bag} holds other scans than were mapped: after that of {report.stamp_ns} ns"
                f" {report.points_used} of {report.points} points are used and there are"
                f" {report.leaves} leaves, by timing.csv {used} of {points} and {leaves}"
            )
        number += 1
        if progress is not None:
            progress(number)
    if number < len(rows):
        missing = f"{len(rows) - number} of the {len(rows)} scans that were mapped"
        raise EvaluationError(f"{bag} lacks {missing}")
    if not counts.points:
        raise EvaluationError(f"{bag}: no point of {number} scans fell on mapped ground")
    return Consistency(counts, number)


def _same(report: ScanReport, points: int, used: int, leaves: int, exact: bool) -> bool:
    """Whether a scan and its map are those of the results; of another version (not ``exact``) only
    the points count. On another processor a few leaves differ, with statistics at a threshold."""
    near = abs(report.leaves - leaves) <= 2 + leaves // 100
    return report.points == points and (not exact or (report.points_used == used and near))
