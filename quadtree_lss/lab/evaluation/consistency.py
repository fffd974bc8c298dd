# SPDX-License-Identifier: Apache-2.0
"""Whether a map's covariances are what they say: residuals of scans before these are mapped (Eq.
46, 61-63), over a whole bag (Table 2)."""

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

#: Share of residuals inside the acceptance interval (1 - alpha), half of the others on either side.
INSIDE = 0.95
#: Least variance, m^2.
FLOOR = 1e-12
#: |n.u| is taken to be at least this (grazing incidence).
MIN_COSINE = 0.05


def acceptance_interval(degrees: int) -> tuple[float, float]:
    """Eq. 62 and Eq. 63: bounds that hold 95 % of the chi distribution of ``degrees``."""
    low, high = chi(degrees).interval(INSIDE)
    return float(low), float(high)


class Fractions(NamedTuple):
    """Shares of residuals below and above the acceptance interval; NaN if there are none."""

    below: float
    above: float


@dataclass(frozen=True)
class Counts:
    """How many residuals lie outside the 95 % interval, which can be added up. ``points``:
    residuals. ``below``, ``above``: of the one-degree test. ``below_3``, ``above_3``: of the
    paper's three-degree test."""

    points: int = 0
    below: int = 0
    above: int = 0
    below_3: int = 0
    above_3: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

    def _shares(self, *outside: int) -> Fractions:
        return Fractions(*(count / (self.points or float("nan")) for count in outside))

    @property
    def one_degree(self) -> Fractions:
        """Consistent if both are 0.025."""
        return self._shares(self.below, self.above)

    @property
    def three_degrees(self) -> Fractions:
        """The paper's Table 2. The residual having one degree of freedom, most lie below."""
        return self._shares(self.below_3, self.above_3)


@dataclass(frozen=True)
class PrefitStatistics:
    """Residuals (N,) of the points of a scan that lie in leaves with a measured plane: which points
    these are, the rows of their leaves, n.(r - c) - d and its standard deviation, m, and d_M (Eq.
    46) of the residual as a vector."""

    point: Index
    row: Index
    residual: Array
    deviation: Array
    mahalanobis: Array

    @property
    def normalised(self) -> Array:
        """(N,) |residual| / deviation, of chi_1 if map and noises are what they say."""
        return np.abs(self.residual) / self.deviation

    def counts(self) -> Counts:
        """How many lie outside the 95 % intervals."""
        outside = []
        for values, degrees in ((self.normalised, 1), (self.mahalanobis, 3)):
            low, high = acceptance_interval(degrees)
            outside += [int((values < low).sum()), int((values > high).sum())]
        return Counts(len(self.point), *outside)


def prefit_statistics(cells: CellMap, scan: RegisteredScan, lidar: LidarConfig) -> PrefitStatistics:
    """Residuals of a scan about the map as it was published before the scan was mapped.

    The residual e = n.(r - c) - d has the variance n^T Sigma_r n + a^T Sigma_P a with Sigma_r of
    Eq. 17 (range and pose) and a = (B^T (r - c), -1). Measured and predicted point lie on one ray
    u, so Eq. 61's residual is e u / (n.u): it is one-dimensional and its d_M (Eq. 46) is a multiple
    of |e|. ``cells``: the map. ``scan``: points (N, 3) about the lidar with their finest cells.
    ``lidar``: of which the range noise matters.
    """
    column, row = squeezed(scan.key)
    of_point = cells.leaf_raster()[row, column]
    point = np.flatnonzero(cells.measured[of_point])
    leaf = of_point[point].astype(np.intp)
    n, r = cells.normal[leaf], scan.points[point]
    arm = r - (np.column_stack([cells.x, cells.y, cells.z]) - scan.origin)[leaf]
    residual = _dot(n, arm)
    # Both axes of the tangent plane (Eq. 2) along the arm.
    share = _dot(n[:, :2], arm[:, :2]) / (1.0 + n[:, 2]) + arm[:, 2]
    a = np.column_stack([arm[:, :2] - share[:, None] * n[:, :2], np.full(len(n), -1.0)])
    plane = np.einsum("ni,nij,nj->n", a, cells.covariance[leaf], a)
    distance = np.linalg.norm(r, axis=1)
    ray = r / distance[:, None]
    cosine = np.maximum(np.abs(_dot(n, ray)), MIN_COSINE)
    noise = lidar.range_noise + lidar.range_noise_per_metre * distance  # Eq. 13
    along = noise**2
    # Pose part of Eq. 17: J Sigma J^T with J = (I, -[r]_x).
    unit = np.broadcast_to(np.eye(3), (len(r), 3, 3))
    jacobian = np.concatenate([unit, -skew(r)], axis=-1)
    pose = jacobian @ scan.pose.covariance @ jacobian.transpose(0, 2, 1)
    variance = plane + along * cosine**2 + np.einsum("ni,nij,nj->n", n, pose, n)
    # What is added along the ray adds to the variance there: the pose's part alone is inverted,
    # kept regular by a millionth of its trace.
    trace = np.trace(pose, axis1=1, axis2=2)
    regular = pose + (1e-6 * trace + FLOOR)[:, None, None] * np.eye(3)
    weight = _dot(ray, np.linalg.solve(regular, ray[..., None])[..., 0])
    total = 1.0 / np.maximum(weight, 1e-300) + along + plane / cosine**2
    deviation = np.sqrt(np.maximum(variance, FLOOR))
    mahalanobis = np.abs(residual) / (cosine * np.sqrt(total))
    return PrefitStatistics(point, leaf, residual, deviation, mahalanobis)


def _dot(one: Array, other: Array) -> Array:
    """Products (N,) of vectors (N, k)."""
    return np.asarray(np.einsum("ni,ni->n", one, other))


@dataclass(frozen=True)
class Consistency:
    """Prefit residuals of a bag. ``counts``: residuals outside the 95 % intervals. ``scans``: scans
    that were mapped; the first has nothing to be compared with."""

    counts: Counts
    scans: int

    def table(self) -> str:
        one, three = self.counts.one_degree, self.counts.three_degrees
        rows = [("Prefit residuals", "below", "above", "both")]
        for name, of in (("one degree of freedom", one), ("three (the paper)", three)):
            rows.append((name, *(f"{share:.2%}" for share in (*of, sum(of)))))
        return "\n".join(aligned(rows))


def consistency(
    bag: str | Path,
    config: Config,
    *,
    results: Results | None = None,
    scan_topic: str | None = None,
    pose_topic: str | None = None,
    progress: Callable[[int], None] | None = None,
) -> Consistency:
    """Map a bag as ``replay`` would; before each scan compare its points with the map as it is.

    With ``results``, only the scans that were mapped into these, which must be the same.
    ``progress`` is called with the number of scans mapped so far. Raises `BagError`: the bag cannot
    be read or its topics are ambiguous; `EvaluationError`: no point of it fell on ground that was
    already mapped, or the scans are not those of the results.
    """
    rows: dict[int, list[int]] = {}
    if results is not None:
        columns = [results.timing[name].tolist() for name in COLUMNS[:4]]
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
        if rows:
            _check(report, rows[report.stamp_ns], exact, bag)
        number += 1
        if progress is not None:
            progress(number)
    if number < len(rows):
        msg = f"{bag} lacks {len(rows) - number} of the {len(rows)} scans that were mapped"
        raise EvaluationError(msg)
    if not counts.points:
        msg = f"{bag}: no point of {number} scans fell on ground that was already mapped"
        raise EvaluationError(msg)
    return Consistency(counts, number)


def _check(report: ScanReport, row: list[int], exact: bool, bag: str | Path) -> None:
    """Compare a scan, and the map after it, with its row of ``timing.csv``.

    Results of another version can only be asked for the points (not ``exact``). Of another
    processor leaves may differ by the few whose statistics lie on a threshold to the last bit.
    """
    points, used, leaves = row
    near = abs(report.leaves - leaves) <= 2 + leaves // 100
    if report.points == points and (not exact or (report.points_used == used and near)):
        return
    raise EvaluationError(
        f"{bag} holds other scans than were mapped: after that of {report.stamp_ns} ns"
        f" {report.points_used} of {report.points} points are used and there are"
        f" {report.leaves} leaves, by timing.csv {used} of {points} and {leaves}"
    )
