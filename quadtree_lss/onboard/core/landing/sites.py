# SPDX-License-Identifier: Apache-2.0
"""Landing sites: what may be landed on, how good it is, and the best of it (paper V.D)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from math import inf, isnan
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array, Bytes, Mask, keep_memory
from quadtree_lss.onboard.config.risk import risk_model
from quadtree_lss.onboard.config.settings import DEFAULTS, Config, LssConfig
from quadtree_lss.onboard.core.landing import hazards
from quadtree_lss.onboard.core.landing.assessment import (
    LandingAssessment,
    Selected,
    Sites,
    no_target,
    nothing_mapped,
    risk_warnings,
)
from quadtree_lss.onboard.core.landing.contact import ContactCheck
from quadtree_lss.onboard.core.landing.grid import (
    Aims,
    GridSampler,
    aim,
    users_grid,
    within_reach,
)
from quadtree_lss.onboard.core.landing.lattice import disc, touching
from quadtree_lss.onboard.core.landing.probability import (
    Dispersion,
    RiskTable,
    contact_limits,
    remaining_risks,
)
from quadtree_lss.onboard.core.landing.ranking import ranked_points
from quadtree_lss.onboard.core.landing.raster import TerrainRaster, rasterise
from quadtree_lss.onboard.core.landing.restrictions import Restrictions
from quadtree_lss.onboard.core.landing.score import (
    SLACK,
    PointAssessment,
    assess_points,
    ground_radius,
    look_around,
    unknown_bits,
    zones_about,
)
from quadtree_lss.onboard.core.landing.target import (
    SETTLE_SHARE,
    Candidates,
    Choice,
    Descent,
    Motion,
    Reason,
    TargetKeeper,
)
from quadtree_lss.onboard.core.tree.cell_map import CellMap, height_by_error

#: Why there is no target, where the same map would not give one either.
WAITING = (Reason.SETTLING, Reason.UNLIKELY)
#: m and a vehicle's diameter: no site lies higher above the vehicle, nor does navigation's height
#: slip by so much on the way down.
ABOVE = 1.0
#: Any heading is as good as another: variance of an angle of which nothing is known, rad^2.
ANY_HEADING = np.pi**2 / 3.0

__all__ = ["LandingAssessment", "LandingSiteSelector", "Selected", "Sites"]


class LandingSiteSelector:
    """Assesses maps.

    Keeps the target (see ``target.TargetKeeper``) and the contacts of the lander, which it computes
    again only where the ground changed.
    """

    def __init__(self, config: Config = DEFAULTS) -> None:
        self._target = TargetKeeper()
        self._number = 0
        keep_memory()
        self.configure(config)

    def configure(self, config: Config) -> None:
        """Go by these limits from now on; what was found by others is forgotten."""
        self.config, lss = config, config.lss
        self._table: RiskTable | None
        self._check: ContactCheck | None
        self._table, self._check, within = None, None, None
        if lss.ranking == "probability":
            model = risk_model(lss.risk_model)
            self._table = RiskTable(model, lss, config.lidar.range_noise)
            within = contact_limits(model, lss)
        if within is not None or lss.assessment != "paper":
            self._check = ContactCheck(lss, within)

    def release(self) -> None:
        """Give the target up: the next assessment chooses as if none had been held."""
        self._target.release()

    def land_now(self) -> None:
        """From the next assessment to `release`, the target is the best place within reach."""
        self._target.land_now()

    def assess(
        self,
        cells: CellMap,
        *,
        area: ArrayLike | None = None,
        keep_out: ArrayLike | None = None,
        keep_outs: Sequence[ArrayLike] = (),
        target: ArrayLike | None = None,
        dispersion: ArrayLike | None = None,
        withheld: str = "",
        vehicle: Sequence[float] | None = None,
        waited: float = inf,
    ) -> LandingAssessment:
        """Rank landing sites on a map.

        Args:
            cells: The map message's content; points are never needed.
            area, keep_outs, target, withheld: As of `Restrictions`: where landing is wanted.
            keep_out: One more of ``keep_outs``.
            dispersion: Deviations of the touchdown from its aim along x and y, m, and the lander's
                heading, rad, NaN for any; None for ``lss.dispersion``, and any. Limits alone are
                looked at for one heading: a risk is that of the worst.
            vehicle: As of `Motion`: height and speed downwards, or its place and speed as well;
                None if nobody knows.
            waited: Since the first map, s: for as long as ``lss.settle_time`` says there is no
                target before enough is seen.

        Raises:
            ValueError: the dispersion is none.
        """
        lss = self.config.lss
        at = users_grid(cells.domain, lss.spacing)
        keep_outs = [*([] if keep_out is None else [keep_out]), *keep_outs]
        wanted = Restrictions(area, keep_outs, target, withheld)
        self._number += 1
        spread = Dispersion.of(dispersion, lss)
        self._target.heed(wanted, self._reach(), lss)
        raster = rasterise(cells, lss)
        if not raster.seen.any():
            reason = Reason.WITHHELD if withheld else Reason.NOTHING_MAPPED
            return self._nothing(cells, at, reason, unknown_bits(raster))
        around = look_around(raster, lss)
        contacts = None
        if self._check is not None:
            # The risk model was fitted to the maximum over all headings.
            heading = spread.heading if self._table is None else None
            contacts = self._check.contacts(raster, around.needs_contact, heading)
        points = assess_points(raster, around, contacts, self._check, self._table, lss)
        aims = aim(points, at, spread, wanted, lss)
        motion = None if vehicle is None else Motion(*vehicle)
        return self._choose_sites(points, aims, spread, wanted, motion, waited)

    def withhold(self, cells: CellMap, why: str) -> LandingAssessment:
        """Neither site nor target, because a map could not be assessed."""
        self._number += 1
        self.configure(self.config)  # what was found by half is forgotten
        at = users_grid(cells.domain, self.config.lss.spacing)
        unseen = np.full((cells.domain.finest_count,) * 2, hazards.UNSEEN, dtype=np.uint8)
        nothing = self._nothing(cells, at, Reason.WITHHELD, unseen)
        return replace(nothing, explanation=f"no site is given out: {why}")

    def _nothing(
        self, cells: CellMap, at: GridSampler, reason: Reason, bits: Bytes
    ) -> LandingAssessment:
        nowhere = np.full((len(at.y), len(at.x)), np.nan)
        ground = Candidates(at.x, at.y, np.isfinite(nowhere), nowhere)
        self._choose(ground, why_not=lambda *_: reason, why_none=reason)
        return nothing_mapped(cells, self._number, reason, at.x, at.y, at.any(touching(bits)))

    def _choose_sites(
        self,
        points: PointAssessment,
        aims: Aims,
        spread: Dispersion,
        wanted: Restrictions,
        motion: Motion | None,
        waited: float,
    ) -> LandingAssessment:
        """Choose the best aims and the target; ``waited`` as of `assess`."""
        lss, cells, at = self.config.lss, points.raster.cells, aims.at
        above = np.zeros_like(aims.candidates.safe)
        if motion is not None:
            # Its height is navigation's; that of the map is another.
            motion = motion._replace(z=motion.z - np.nan_to_num(cells.offset_z))
            ground = at.linear(points.around.planes.elevation)
            above = ground > motion.z + ABOVE + lss.vehicle.diameter
            above &= aims.hazard & hazards.UNSEEN == 0
            aims = aims.without(above)
        warnings: tuple[str, ...] = ()
        if self._table is not None:
            warnings = risk_warnings(self.config, points.raster, points.around.judged)
        landable = bool(aims.candidates.permitted.any())
        seen = wanted.share(aims.hazard & hazards.UNSEEN == 0, at.x, at.y)
        settled = seen >= SETTLE_SHARE or waited >= lss.settle_time
        below = descent = None
        if motion is not None:
            below = _descent(points, at, motion, (motion.x, motion.y))
            descent = _descent(points, at, motion, self._target.held)
        here = within_reach(aims, wanted, lss, motion, below)
        choice = self._choose(
            aims.candidates,
            why_not=partial(_why_not, points, aims, above, wanted, lss),
            why_none=Reason.WITHHELD if aims.withheld else Reason.NO_SITE,
            descent=descent,
            settled=settled,
            now=here,
        )
        sites, apart = aims.candidates, lss.vehicle.lengths.min_separation
        steps = apart / (at.x[1] - at.x[0]) if len(at.x) > 1 else 0.0
        best = ranked_points(sites.cost, sites.unsafe, sites.clearance, steps, lss.sites)
        ranked = [*zip(*best, strict=True)]
        places = ranked if choice.place is None else [*ranked, choice.place]
        found = self._describe(points, aims, spread, places)
        now = np.full(4, np.nan)
        if here.best is not None:
            row, column = here.best
            height = at.linear(points.around.planes.elevation)[here.best]
            now[:] = at.x[column], at.y[row], height, aims.probability[here.best]
        return LandingAssessment(
            stamp_ns=cells.stamp_ns,
            number=self._number,
            selected=self._selected(choice, found, aims, points.raster),
            seen=seen,
            pending=landable and choice.place is None and choice.reason not in WAITING,
            sites=found.of(slice(len(ranked))),
            now=now,
            x=at.x,
            y=at.y,
            hazard=aims.hazard,
            safe=aims.candidates.safe,
            score=aims.score,
            probability=aims.probability,
            risk=aims.risk,
            explanation=_explanation(points, aims, above, wanted, lss),
            offset_z=cells.offset_z,
            offset_variance=cells.offset_variance,
            ground=(at, points),
            warnings=warnings,
            lss=lss,
        )

    def _choose(self, ground: Candidates, **situation: Any) -> Choice:
        return self._target.choose(ground, self.config.lss, reach=self._reach(), **situation)

    def _reach(self) -> float:
        """How far from each other sites are the same, m: no two of a ranking are."""
        lss = self.config.lss
        return 0.49 * min(lss.vehicle.diameter, lss.vehicle.lengths.min_separation)

    def _selected(
        self, choice: Choice, found: Sites, aims: Aims, raster: TerrainRaster
    ) -> Selected:
        """The target, described in the last row of ``found``."""
        if choice.place is None:
            best = float("nan") if choice.best is None else float(aims.probability[choice.best])
            return no_target(choice.reason, choice.state, best)
        site = replace(found.of(slice(-1, None)), id=np.array([choice.id], dtype=np.uint32))
        place_x, place_y, _ = site.position[0]
        covariance = ground_covariance(raster, place_x, place_y, ground_radius(self.config.lss))
        return Selected(choice.reason, choice.state, float(site.probability[0]), site, covariance)

    def _describe(
        self, points: PointAssessment, aims: Aims, spread: Dispersion, places: list[tuple[int, int]]
    ) -> Sites:
        """What is known of landing at grid points, given by row and column."""
        lss, around, at = self.config.lss, points.around, aims.at
        vehicle = lss.vehicle
        where = tuple(np.array(places, dtype=np.intp).reshape(-1, 2).T)
        place = np.column_stack([at.x[where[1]], at.y[where[0]]])
        centre = at.lattice(*where)
        rough, raised, room = zones_about(points, centre, place, lss)
        along_x, along_y = around.planes.slope_x[centre], around.planes.slope_y[centre]
        normal = np.column_stack([-along_x, -along_y, np.ones_like(along_x)])
        slope_deg = np.degrees(np.arctan(around.planes.gradient[centre]))
        risks = [""] * len(places)
        if points.contacts is not None and self._table is not None:
            reach = 0.5 * vehicle.diameter + vehicle.pad_radius
            unmapped = around.to_unmapped < (1.0 - SLACK) * reach
            judged = around.judged, unmapped, points.cause
            side = points.raster.domain.finest_size
            risks = [
                f"{of}; " for of in remaining_risks(centre, points.risk, *judged, side, spread)
            ]
        limit = vehicle.max_slope_deg
        if lss.assessment == "touchdown":
            limit = vehicle.lengths.touchdown_slope_deg
        reasons = (
            f"{risk}slope {slope:.1f}° of {limit:g}°, {clear:.1f} m clear of hazards and "
            f"unobserved ground, roughness {roughness:.3f} m, "
            + (
                f"features up to {feature:.2f} m"
                if feature >= vehicle.lengths.negligible
                else "no subscale feature"
            )
            for risk, slope, clear, roughness, feature in zip(
                risks, slope_deg, room, rough, raised, strict=True
            )
        )
        return Sites(
            position=np.column_stack([place, at.linear(around.planes.elevation)[where]]),
            normal=normal / np.linalg.norm(normal, axis=1, keepdims=True),
            score=aims.score[where],
            probability=aims.probability[where],
            slope_deg=slope_deg,
            roughness=rough,
            hazard_distance=room,
            subscale_height=raised,
            id=self._target.places.numbers(place, self._reach()),
            reasons=tuple(reasons),
        )


def _why_not(
    points: PointAssessment,
    aims: Aims,
    above: Mask,
    wanted: Restrictions,
    lss: LssConfig,
    row: int,
    column: int,
) -> Reason:
    """Why landing is not permitted at a grid point; ``above``: (ny, nx) those over the vehicle."""
    at, around = aims.at, points.around
    if aims.withheld or above[row, column]:
        return Reason.WITHHELD
    if unwanted := wanted.fault(at.x[column], at.y[row], lss):
        return unwanted
    if at.everywhere(around.room >= (1.0 - SLACK) * lss.zone)[row, column]:
        return Reason.HAZARD
    reach = (1.0 - SLACK) * (lss.zone + lss.vehicle.pad_radius)
    mapped = at.everywhere(around.to_unmapped >= reach)[row, column]
    return Reason.UNSEEN if mapped else Reason.UNMAPPED


def _descent(
    points: PointAssessment, at: GridSampler, motion: Motion, over: tuple[float, float] | None
) -> Descent:
    """Over a place; without one, or where its ground is not seen, over all of the ground."""
    ground = float("nan")
    if over is not None and at.x[0] <= over[0] <= at.x[-1] and at.y[0] <= over[1] <= at.y[-1]:
        row = at.near[0][np.abs(at.y - over[1]).argmin()]
        column = at.near[1][np.abs(at.x - over[0]).argmin()]
        if points.raster.seen[max(row - 1, 0) : row + 1, max(column - 1, 0) : column + 1].any():
            ground = float(points.around.planes.elevation[row, column])
    if isnan(ground):
        ground = float(np.mean(points.raster.elevation[points.raster.seen]))
    return Descent(motion.z - ground, motion.down)


def _explanation(
    points: PointAssessment, aims: Aims, above: Mask, wanted: Restrictions, lss: LssConfig
) -> str:
    """How many grid points are safe, or why there are no sites."""
    safe, raster = aims.candidates.safe, points.raster
    if aims.withheld:
        return f"no site is given out: {aims.withheld}"
    if aims.candidates.permitted.any():
        return f"{np.count_nonzero(safe)} of {safe.size} grid points are safe"
    if beside := wanted.beside(aims.at.x, aims.at.y):
        return f"no safe site: {beside}"
    if safe.any():
        text = "no safe ground within the landing area and outside the keep-outs"
        if above.any():
            text += " that does not lie above the vehicle: poses in NED, or the lidar's mount is"
            text += " another; quadtree-lss doctor says which"
        return text
    seen, unmapped = float(np.mean(raster.seen)), float(np.mean(raster.unmapped))
    hazardous = (points.hazard & hazards.IDENTIFIED > 0) & (points.hazard & hazards.UNSEEN == 0)
    return (
        f"no safe site: {100.0 * seen:.0f} % of the domain is seen, "
        + (f"{100.0 * unmapped:.0f} % seen but not yet mapped, " if unmapped > 0.0 else "")
        + f"{100.0 * float(np.mean(hazardous)):.0f} % shows a hazard, and no zone of "
        f"{lss.zone:.2f} m radius is both seen and allowed"
    )


def ground_covariance(raster: TerrainRaster, x: float, y: float, radius: float) -> Array:
    """Covariance (6, 6) of the ground's plane at the lander's scale, about a place of the map.

    Order and axes are those of ``PoseWithCovariance``: x, y, z in m, rotations about the map's
    fixed axes in rad. The place in x and y is one of the map, and has no error of its own: its rows
    are 0. Height and tilt are those of the least-squares plane over the leaves' planes in a disc
    (see `lattice.ground_planes`). Range noise is another one in each leaf; the error of the poses
    is common to all of the map nearby, and enters as that of one plane. Slopes are taken for small.
    ``raster``: the map. ``x``, ``y``: the place, map frame, m. ``radius``: of the disc, m.
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
    # Ground that rises along y is turned about x, ground that rises along x about -y.
    turn = np.zeros((6, 3))
    turn[2, 0], turn[3, 2], turn[4, 1] = 1.0, 1.0, -1.0
    covariance = turn @ out @ turn.T
    covariance[5, 5] = ANY_HEADING
    return np.asarray(covariance)
