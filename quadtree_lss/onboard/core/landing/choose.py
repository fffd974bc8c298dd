# SPDX-License-Identifier: Apache-2.0
"""Step 5 of an assessment: ranked sites with reasons, and the target."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from quadtree_lss.onboard.arrays import Array, Index
from quadtree_lss.onboard.config.settings import Config, LssConfig
from quadtree_lss.onboard.core.landing import hazards
from quadtree_lss.onboard.core.landing.aim import Aims, touchdown_weights
from quadtree_lss.onboard.core.landing.lattice import disc, steps_to_marked
from quadtree_lss.onboard.core.landing.ranking import GridIndex
from quadtree_lss.onboard.core.landing.raster import RELATIVE_ROUNDING, TerrainRaster
from quadtree_lss.onboard.core.landing.result import (
    LandingAssessment,
    Selected,
    Sites,
    no_target,
    shown,
)
from quadtree_lss.onboard.core.landing.risk import risk_warnings
from quadtree_lss.onboard.core.landing.score import PointAssessment
from quadtree_lss.onboard.core.landing.target import (
    SETTLE_SHARE,
    Choice,
    Reason,
    Situation,
    TargetKeeper,
)
from quadtree_lss.onboard.core.tree.cell_map import height_by_error

#: Reasons for no target that another assessment of the same map does not change.
NOT_PENDING = (Reason.SETTLING, Reason.UNLIKELY)
#: Variance of an unknown heading (uniform distribution), rad^2.
UNKNOWN_HEADING_VARIANCE = np.pi**2 / 3.0
#: Sources of risk: those of `config.risk.CAUSES`, and the ground that is not assessable.
SOURCES = ["obstacles", "steep slopes", "possible obstacles too small to detect"]
SOURCES += ["ground observed but not estimated", "unobserved ground"]


def choose(
    points: PointAssessment, aims: Aims, keeper: TargetKeeper, waited: float, config: Config
) -> LandingAssessment:
    """Rank sites and choose the target; updates ``keeper``. ``waited``: since the first map, s."""
    lss, cells, grid, candidates = config.lss, points.raster.cells, aims.grid, aims.candidates
    seen = aims.restrictions.observed_share(aims.hazard & hazards.UNSEEN == 0, grid.x, grid.y)
    no_site_reason = Reason.WITHHELD if aims.restrictions.why_withheld else Reason.NO_SITE
    settled = seen >= SETTLE_SHARE or waited >= lss.settle_time
    reason_at = partial(_reason_at, points, aims, lss)
    choice = keeper.choose(
        Situation(candidates, lss, reason_at, no_site_reason, aims.descent, settled, aims.now)
    )
    ranked = candidates.ranked(lss.vehicle.lengths.min_separation, lss.sites)
    described = ranked if choice.point is None else [*ranked, choice.point]
    sites = _describe(points, aims, described, keeper, lss)
    now = np.full(4, np.nan)
    if (best := aims.now.best) is not None:
        now[:] = grid.x[best[1]], grid.y[best[0]], aims.elevation[best], aims.probability[best]
    landable = bool(candidates.permitted.any())
    return LandingAssessment(
        stamp_ns=cells.stamp_ns,
        number=keeper.assessments,
        selected=_selected(choice, sites, aims, points.raster, lss),
        seen=seen,
        pending=landable and choice.point is None and choice.reason not in NOT_PENDING,
        sites=sites[: len(ranked)],
        now=now,
        x=grid.x,
        y=grid.y,
        hazard=aims.hazard,
        safe=candidates.safe,
        score=aims.score,
        probability=aims.probability,
        risk=candidates.risk,
        explanation=_explanation(points, aims, lss),
        offset_z=cells.offset_z,
        offset_variance=cells.offset_variance,
        lss=lss,
        terrain=(grid, points),
        warnings=risk_warnings(config, points.raster) if lss.ranking == "probability" else (),
    )


def _selected(
    choice: Choice, sites: Sites, aims: Aims, raster: TerrainRaster, lss: LssConfig
) -> Selected:
    """Return the target, which is the last of ``sites``."""
    if choice.point is None:
        best = float("nan") if choice.best is None else float(aims.probability[choice.best])
        return no_target(choice.reason, choice.state, best)
    site = replace(sites[-1:], id=np.array([choice.id], dtype=np.uint32))
    x, y, _ = site.position[0]
    covariance = ground_covariance(raster, x, y, lss.vehicle.ground_radius)
    return Selected(choice.reason, choice.state, float(site.probability[0]), site, covariance)


def _describe(
    points: PointAssessment,
    aims: Aims,
    grid_points: list[GridIndex],
    keeper: TargetKeeper,
    lss: LssConfig,
) -> Sites:
    """Describe sites at grid points; ``grid_points``: row and column of each."""
    vehicle, planes, grid = lss.vehicle, points.raster.planes, aims.grid
    rows, columns = np.array(grid_points, dtype=np.intp).reshape(-1, 2).T
    position = np.column_stack([grid.x[columns], grid.y[rows]])
    nearest = grid.nearest_row[rows], grid.nearest_column[columns]
    rough, raised, free_distance = _describe_zones(points, nearest, position, lss)
    numbers = [keeper.site_numbers.number(x, y, lss) for x, y in position.tolist()]
    slope_x, slope_y = planes.slope_x[nearest], planes.slope_y[nearest]
    normal = np.column_stack([-slope_x, -slope_y, np.ones_like(slope_x)])
    slope_deg = np.degrees(np.arctan(planes.gradient[nearest]))
    risks = [""] * len(grid_points)
    if lss.ranking == "probability":
        risks = _risk_texts(points, aims, nearest, aims.probability[rows, columns], lss)
    limit = vehicle.max_slope_deg
    if lss.assessment == "touchdown":
        limit = vehicle.lengths.touchdown_slope_deg
    columns_of_text = risks, slope_deg, free_distance, rough, raised
    reasons = []
    for risk, slope, clear, roughness, feature in zip(*columns_of_text, strict=True):
        features = "no subscale feature"
        if feature >= vehicle.lengths.negligible:
            features = f"features up to {feature:.2f} m"
        reasons.append(
            f"{risk}slope {slope:.1f}° of {limit:g}°, {clear:.1f} m clear of hazards and "
            f"unobserved ground, roughness {roughness:.3f} m, {features}"
        )
    return Sites(
        position=np.column_stack([position, aims.elevation[rows, columns]]),
        normal=normal / np.linalg.norm(normal, axis=1, keepdims=True),
        score=aims.score[rows, columns],
        probability=aims.probability[rows, columns],
        slope_deg=slope_deg,
        roughness=rough,
        hazard_distance=free_distance,
        subscale_height=raised,
        id=np.array(numbers, dtype=np.uint32),
        reasons=tuple(reasons),
    )


def _describe_zones(
    points: PointAssessment, nearest: tuple[Index, Index], position: Array, lss: LssConfig
) -> tuple[Array, Array, Array]:
    """Describe the landing zones about positions (K, 2), m, near points of the lattice.

    Returns (K,) each, m: greatest roughness; greatest height of a subscale feature; how far the
    zone can move in any direction until it touches a hazard (with the touchdown check: until a
    touchdown within the margin fails), unobserved ground or the domain's border.
    """
    raster, domain, zone = points.raster, points.raster.domain, lss.zone
    side, last = domain.finest_size, domain.finest_count - 1
    over = disc(min(zone, 0.5 * domain.size), side)
    # Beyond the border, the cells at the border continue.
    row = np.clip(nearest[0][:, None] + over.row, 0, last)
    column = np.clip(nearest[1][:, None] + over.column, 0, last)
    rough, raised = points.roughness[raster.leaf[row, column]], raster.subscale_peak[row, column]
    x, y = position[:, 0] - domain.xmin, position[:, 1] - domain.ymin
    free_distance = np.minimum.reduce([x, domain.size - x, y, domain.size - y]) - zone
    marks = (
        (points.excluded.view(np.uint8), points.distance),
        ((~raster.interior).view(np.uint8), zone),
        (raster.unestimated.view(np.uint8), zone + lss.vehicle.pad_radius),
    )
    for k, free in enumerate(free_distance):
        for marked, reach in marks:
            # Cells have an extent, lattice points have none.
            half, limit = 0.5 * (domain.finest_count + 1 - len(marked)), (free + reach) / side
            steps = steps_to_marked(marked, half, x[k] / side, y[k] / side, limit + 1.0)
            free = min(free, steps * side - reach)
        free_distance[k] = free
    return rough.max(axis=1), raised.max(axis=1), np.maximum(free_distance, 0.0)


def _risk_texts(
    points: PointAssessment,
    aims: Aims,
    nearest: tuple[Index, Index],
    chances: Array,
    lss: LssConfig,
) -> list[str]:
    """Describe the risk at aim points, as in "probability 99.2 %; 80 % of the risk comes from
    obstacles; "; ``nearest``: rows and columns (K,) of the lattice; ``chances``: (K,)."""
    raster, texts = points.raster, []
    across, along = touchdown_weights(points.risk.shape, raster.domain.finest_size, aims.dispersion)
    border = (len(across) // 2,) * 2, (len(along) // 2,) * 2
    reach = (1.0 - RELATIVE_ROUNDING) * (0.5 * lss.vehicle.diameter + lss.vehicle.pad_radius)
    unknown = np.where(raster.to_unestimated < reach, np.uint8(3), np.uint8(4))
    source = np.where(raster.assessable, points.cause, unknown)
    source = np.pad(source, border, constant_values=4)
    risk = np.pad(points.risk, border, constant_values=1.0)
    for row, column, chance in zip(*nearest, chances, strict=True):
        window = np.s_[row : row + len(across), column : column + len(along)]
        part = across[:, None] * along * risk[window]
        parts = np.bincount(source[window].ravel(), part.ravel())
        share = 100.0 * parts.max() / (parts.sum() or 1.0)
        text = f"{share:.0f} % of the risk comes from {SOURCES[parts.argmax()]}; "
        texts.append(f"probability {shown(chance)}; {text * bool(chance < 0.9999)}")
    return texts


def _reason_at(
    points: PointAssessment, aims: Aims, lss: LssConfig, row: int, column: int
) -> Reason:
    """Return why landing is not permitted at a grid point."""
    grid, raster = aims.grid, points.raster
    if aims.restrictions.why_withheld or aims.above[row, column]:
        return Reason.WITHHELD
    if reason := aims.restrictions.reason_against(grid.x[column], grid.y[row], lss):
        return reason
    if grid.all(raster.free_distance >= (1.0 - RELATIVE_ROUNDING) * lss.zone)[row, column]:
        return Reason.HAZARD
    reach = (1.0 - RELATIVE_ROUNDING) * (lss.zone + lss.vehicle.pad_radius)
    mapped = grid.all(raster.to_unestimated >= reach)[row, column]
    return Reason.UNSEEN if mapped else Reason.UNMAPPED


def _explanation(points: PointAssessment, aims: Aims, lss: LssConfig) -> str:
    """Return how many grid points are safe, or why there are no sites."""
    safe, raster = aims.candidates.safe, points.raster
    if aims.restrictions.why_withheld:
        return f"no site is given out: {aims.restrictions.why_withheld}"
    if aims.candidates.permitted.any():
        return f"{np.count_nonzero(safe)} of {safe.size} grid points are safe"
    if outside := aims.restrictions.outside_domain(aims.grid.x, aims.grid.y):
        return f"no safe site: {outside}"
    if safe.any():
        text = "no safe ground within the landing area and outside the keep-outs"
        if aims.above.any():
            text += " that does not lie above the vehicle: poses in NED, or the lidar's mount is"
            text += " another; quadtree-lss doctor says which"
        return text
    observed, unestimated = float(np.mean(raster.observed)), float(np.mean(raster.unestimated))
    hazardous = (points.hazard & hazards.IDENTIFIED > 0) & (points.hazard & hazards.UNSEEN == 0)
    return (
        f"no safe site: {100.0 * observed:.0f} % of the domain is observed, "
        + (f"{100.0 * unestimated:.0f} % observed but not estimated, " if unestimated > 0.0 else "")
        + f"{100.0 * float(np.mean(hazardous)):.0f} % shows a hazard, and no zone of "
        f"{lss.zone:.2f} m radius is both observed and allowed"
    )


def ground_covariance(raster: TerrainRaster, x: float, y: float, radius: float) -> Array:
    """Compute the covariance (6, 6) of the ground's plane at the vehicle's scale about x and y.

    Order and axes are those of ``PoseWithCovariance``: x, y, z in m, rotations about the map's
    fixed axes in rad. The position in x and y is exact: its rows are 0. Height and tilt are those
    of the least-squares plane over the leaves' planes in a disc (see `lattice.ground_planes`).
    Range noise is independent between leaves; the pose error is common to all of them and enters
    as that of the nearest plane. Slopes are small. ``x``, ``y``, ``radius``: m.
    """
    cells, domain = raster.cells, raster.domain
    side, last = domain.finest_size, domain.finest_count - 1
    over = disc(radius, side)
    at_x, at_y = (x - domain.xmin) / side, (y - domain.ymin) / side
    row = (round(at_y) + over.row).clip(0, last)
    column = (round(at_x) + over.column).clip(0, last)
    leaf, of_cell = np.unique(raster.leaf[row, column], return_inverse=True)
    known = cells.measured[leaf]
    if not known.any():
        return np.full((6, 6), np.nan)
    size = domain.cell_size(cells.level[leaf])
    middle_x = domain.xmin + (cells.ix[leaf] + 0.5) * size
    middle_y = domain.ymin + (cells.iy[leaf] + 0.5) * size
    normal = cells.normal[leaf]
    heights = height_by_error(
        normal[of_cell], x + over.x - middle_x[of_cell], y + over.y - middle_y[of_cell]
    )
    of_leaf = (of_cell == np.flatnonzero(known)[:, None])[:, None] * over.to_plane @ heights
    out = np.sum(of_leaf @ cells.covariance_range[leaf[known]] @ of_leaf.swapaxes(1, 2), axis=0)
    nearest = of_cell[np.argmin(np.where(known[of_cell], np.hypot(over.x, over.y), np.inf))]
    across = x + over.x - middle_x[nearest], y + over.y - middle_y[nearest]
    common = over.to_plane @ height_by_error(normal[nearest, None], *across)
    out += common @ cells.covariance_pose[leaf[nearest]] @ common.T
    # Ground that rises along y is rotated about x, ground that rises along x about -y.
    turn = np.zeros((6, 3))
    turn[2, 0], turn[3, 2], turn[4, 1] = 1.0, 1.0, -1.0
    covariance = turn @ out @ turn.T
    covariance[5, 5] = UNKNOWN_HEADING_VARIANCE
    return np.asarray(covariance)
