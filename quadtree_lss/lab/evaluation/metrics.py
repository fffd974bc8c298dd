# SPDX-License-Identifier: Apache-2.0
"""Metrics of a map and its landing sites against the truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.ndimage import binary_closing, distance_transform_edt

from quadtree_lss.desk.exchange.saved import Grid
from quadtree_lss.desk.replay.results import aligned
from quadtree_lss.lab.evaluation.results import Truth
from quadtree_lss.lab.simulation.safety import contact_safe, on_dem, safety_map
from quadtree_lss.lab.simulation.terrain import bilinear
from quadtree_lss.onboard.arrays import Array, Index, Mask
from quadtree_lss.onboard.core.landing.hazards import UNMAPPED
from quadtree_lss.onboard.core.tree.cell_map import CellMap

#: Bounds of the bins of predicted risk.
RISK_EDGES = (0.0, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
#: Probabilities in a log score are clipped here.
MIN_PROBABILITY = 1e-6
#: Largest distance between points where elevations are compared, m; tolerance of coordinates, m.
_SAMPLE_STEP, _COINCIDE = 0.5, 1e-3
#: ``unknown``: the lander would reach over the edge of the true terrain.
SiteVerdict = Literal["safe", "unsafe", "unknown"]


@dataclass(frozen=True)
class ElevationError:
    """Estimate minus truth (m) over observed terrain, sampled evenly in area."""

    mean_absolute: float
    rms: float
    maximum: float
    mean: float
    mean_absolute_mean_removed: float
    rms_mean_removed: float
    samples: int
    without_estimate: float  # fraction of the observed finest cells


@dataclass(frozen=True)
class Detection:
    """Detection of hazardous and safe ground (Table 3), over observed ground with small holes
    filled: fractions of the grid points, NaN without any. The holes and ground without an estimate
    are unknown."""

    hazardous_found: float  # not called safe, of the truly hazardous
    safe_found: float  # called safe, of the truly safe
    hazardous_unknown: float  # of the truly hazardous
    safe_unknown: float
    hazardous_grid_points: int
    safe_grid_points: int
    missed_grid_points: int
    missed_depth: float  # distance of the deepest missed grid point from safe ground, m
    unseen_box: float  # of the scanned box: not scored
    precision: float  # truly safe, of those called safe


@dataclass(frozen=True)
class SafetyField:
    """Grid points of the box: x (nx,), y (ny,), arrays (ny, nx); ``risk`` where the map has one."""

    x: Array
    y: Array
    truly_safe: Mask
    called_safe: Mask
    seen: Mask
    scored: Mask
    risk: Array | None = None


def elevation_error(cells: CellMap, grid: Grid, truth: Truth) -> ElevationError:
    """Compare leaf planes with the truth at points spread evenly over the finest cells; NaN if
    nothing was observed."""
    domain = cells.domain
    parts = max(2, int(np.ceil(domain.finest_size / _SAMPLE_STEP)))
    step = domain.finest_size / parts
    offsets = (np.arange(domain.finest_count * parts, dtype=np.float64) + 0.5) * step
    x, y = domain.xmin + offsets, domain.ymin + offsets
    leaf = cells.leaf_raster()
    with np.errstate(invalid="ignore"):
        fine = leaf.repeat(parts, axis=0).repeat(parts, axis=1)
        error = cells.heights(fine, x[None, :], y[:, None]) - truth.elevation_at(*np.meshgrid(x, y))
    unseen = bilinear(grid.x, grid.y, ~grid.seen, x[None, :], y[:, None])
    error = error[(unseen < 1e-8) & np.isfinite(error)]  # all grid points around are estimated
    estimated = cells.estimated[leaf[cells.observed]]
    without = float(1.0 - estimated.mean()) if estimated.size else float("nan")
    if not error.size:
        return ElevationError(*[float("nan")] * 6, 0, without)
    size, within = np.abs(error), error - error.mean()
    return ElevationError(
        mean_absolute=float(size.mean()),
        rms=float(np.sqrt(np.square(error).mean())),
        maximum=float(size.max()),
        mean=float(error.mean()),
        mean_absolute_mean_removed=float(np.abs(within).mean()),
        rms_mean_removed=float(np.sqrt(np.square(within).mean())),
        samples=error.size,
        without_estimate=without,
    )


def fill_holes(seen: Mask, spacing: float) -> Mask:
    """Close gaps up to 2 m wide by a morphological closing with a disc."""
    radius = 1.0 / spacing
    reach = int(np.floor(radius + 1e-9))
    if reach == 0:
        return seen
    span = np.arange(-reach, reach + 1)
    disc = span[None, :] ** 2 + span[:, None] ** 2 <= radius**2 + 1e-9
    padded = np.pad(seen, reach)
    return np.asarray(binary_closing(padded, disc)[reach:-reach, reach:-reach]) | seen


def safety_field(grid: Grid, truth: Truth) -> SafetyField:
    """Compare map and truth at the map's grid points in the scanned box. If the truth has other
    grid points, the contact is simulated."""
    xmin, xmax, ymin, ymax = truth.box
    in_x, in_y = (
        np.flatnonzero((axis >= low - _COINCIDE) & (axis <= high + _COINCIDE))
        for axis, low, high in ((grid.x, xmin, xmax), (grid.y, ymin, ymax))
    )
    i, same_x = _nearest(truth.safe_x, grid.x[in_x])
    j, same_y = _nearest(truth.safe_y, grid.y[in_y])
    if same_x.all() and same_y.all():
        truly_safe = truth.safe[np.ix_(j, i)]
    else:
        truly_safe = safety_map(truth, grid.x[in_x], grid.y[in_y], truth.lander)
    window = np.ix_(in_y, in_x)
    observed = grid.seen | ((grid["hazard"] & UNMAPPED) > 0)
    risk = grid.layers.get("risk")
    return SafetyField(
        x=grid.x[in_x],
        y=grid.y[in_y],
        truly_safe=truly_safe,
        called_safe=grid["safe"][window],
        seen=grid.seen[window],
        scored=fill_holes(observed, grid.spacing)[window],
        risk=None if risk is None else risk[window],
    )


def _nearest(axis: Array, values: Array) -> tuple[Index, Mask]:
    """Indices of the coordinates on ``axis`` nearest to values (K,), and whether they coincide."""
    near = np.abs(axis[:, None] - values).argmin(axis=0)
    return near, np.abs(axis[near] - values) < _COINCIDE


def detection(field: SafetyField) -> Detection:
    """Detection rates of Table 3; NaN over no grid points."""
    hazardous = field.scored & ~field.truly_safe
    safe = field.scored & field.truly_safe
    called = field.called_safe & field.seen
    missed = hazardous & called
    spacing = float(field.x[1] - field.x[0]) if field.x.size > 1 else 0.0
    depth = distance_transform_edt(np.pad(~field.truly_safe, 1, mode="edge"))[1:-1, 1:-1]

    def share(part: Mask, whole: Mask) -> float:
        return float(part[whole].mean()) if whole.any() else np.nan

    return Detection(
        hazardous_found=share(~called, hazardous),
        safe_found=share(called, safe),
        hazardous_unknown=share(~field.seen, hazardous),
        safe_unknown=share(~field.seen, safe),
        hazardous_grid_points=int(hazardous.sum()),
        safe_grid_points=int(safe.sum()),
        missed_grid_points=int(missed.sum()),
        missed_depth=spacing * float(depth[missed].max(initial=0.0)),
        unseen_box=float(1.0 - field.scored.mean()) if field.scored.size else float("nan"),
        precision=share(field.truly_safe, called & field.scored),
    )


def site_verdicts(sites: Array, truth: Truth) -> tuple[SiteVerdict, ...]:
    """True safety of each site (K, 2 or 3): from the true safety map at its grid points, elsewhere
    from the contact on the DEM."""
    places = sites[:, :2]
    known, safe = on_dem(truth, places, truth.lander), contact_safe(truth, places, truth.lander)
    (i, same_x), (j, same_y) = map(_nearest, (truth.safe_x, truth.safe_y), places.T)
    same = same_x & same_y
    safe = np.where(same, truth.safe[j, i], safe)
    words: tuple[SiteVerdict, ...] = ("unknown", "unsafe", "safe")
    return tuple(words[k] for k in (known | same) * (1 + safe))


@dataclass(frozen=True)
class RiskBin:
    """Grid points with a predicted risk from ``low`` to ``high``: their mean risk and the share
    that is truly unsafe; NaN without a grid point."""

    low: float
    high: float
    grid_points: int
    predicted: float
    unsafe: float


@dataclass(frozen=True)
class Reliability:
    """Scores of the predicted risk at observed grid points; lower is better."""

    brier: float
    log_score: float
    grid_points: int
    bins: tuple[RiskBin, ...]

    def table(self) -> str:
        rows = [("Risk", "grid points", "predicted", "unsafe")]
        for b in self.bins:
            if b.grid_points:
                name, shares = f"{100.0 * b.low:g} - {100.0 * b.high:g} %", (b.predicted, b.unsafe)
                rows.append((name, str(b.grid_points), *(f"{100.0 * p:.2f} %" for p in shares)))
        return "\n".join(aligned(rows))


def scores(risk: Array, failed: Mask, weight: Array | None = None) -> tuple[float, float]:
    """Weighted Brier score and log score of risks (K,)."""
    clipped = np.clip(risk, MIN_PROBABILITY, 1.0 - MIN_PROBABILITY)
    log = -np.where(failed, np.log(clipped), np.log1p(-clipped))
    brier = np.square(risk - failed)
    return float(np.average(brier, weights=weight)), float(np.average(log, weights=weight))


def reliability_of(safety: SafetyField) -> Reliability | None:
    """Reliability at observed grid points; None without risks. A risk of 1 marks unobserved ground
    under the lander and is not a prediction."""
    if safety.risk is None or not (predicted := safety.seen & (safety.risk < 1.0)).any():
        return None
    given, true = safety.risk[predicted], ~safety.truly_safe[predicted]
    bins = []
    for low, high in zip(RISK_EDGES, RISK_EDGES[1:], strict=False):
        here = (given >= low) & (given < high)
        shares = (given[here].mean(), true[here].mean()) if here.any() else (np.nan, np.nan)
        bins.append(RiskBin(low, high, int(here.sum()), float(shares[0]), float(shares[1])))
    return Reliability(*scores(given, true), given.size, tuple(bins))
