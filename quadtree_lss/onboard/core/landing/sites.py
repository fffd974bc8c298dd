# SPDX-License-Identifier: Apache-2.0
"""Landing sites: what may be landed on, how good it is, and the best of it (paper V.D)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import Config, LssConfig
from quadtree_lss.onboard.core.landing import hazards
from quadtree_lss.onboard.core.landing.assessment import (
    LandingAssessment,
    Selected,
    Sites,
    no_target,
    nothing_mapped,
    with_reasons,
)
from quadtree_lss.onboard.core.landing.covariance import ground_covariance
from quadtree_lss.onboard.core.landing.grid import GridSampler, best_points, users_grid
from quadtree_lss.onboard.core.landing.lattice import touching
from quadtree_lss.onboard.core.landing.probability import Dispersion
from quadtree_lss.onboard.core.landing.raster import TerrainRaster, rasterise
from quadtree_lss.onboard.core.landing.restrictions import Restrictions
from quadtree_lss.onboard.core.landing.safety import Judgement, SafetyJudge
from quadtree_lss.onboard.core.landing.score import (
    PointAssessment,
    assess_points,
    greatest_about,
    ground_radius,
    meets_unmapped,
    planes_below,
    room_about,
    seen_about,
    unknown_bits,
)
from quadtree_lss.onboard.core.landing.target import (
    Choice,
    Ground,
    Reason,
    TargetKeeper,
    WhyNot,
    grid_point,
)
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.domain import Domain

#: The most that the score weighs against a probability: it decides where these are the same.
TIE = 1e-5

__all__ = ["LandingAssessment", "LandingSiteSelector", "Selected", "Sites"]


class LandingSiteSelector:
    """Assesses maps.

    Keeps the target (see ``target.TargetKeeper``), the last ranking, for ``lss.hysteresis``, and
    the verdicts of the touchdown check, to repeat only what changed.
    """

    def __init__(self, config: Config) -> None:
        self._target = TargetKeeper()
        self._answers = 0
        self._wish: tuple[object, ...] | None = None
        self._last_ranked: list[tuple[float, float]] = []
        # What glibc has freed once in this size it keeps: the arrays of a map need not be got
        # from the system, page by page, for every map.
        np.empty(31 << 20, dtype=np.uint8)
        self.configure(config)

    def configure(self, config: Config) -> None:
        """Go by these limits from now on; what was found by others is forgotten."""
        self.config = config
        self._judge = SafetyJudge(config.lss, config.lidar.range_noise)

    def release(self) -> None:
        """Give the target up: the next assessment chooses as if none had been held."""
        self._target.release()

    def assess(
        self,
        cells: CellMap,
        *,
        area: ArrayLike | None = None,
        keep_out: ArrayLike | None = None,
        target: ArrayLike | None = None,
        dispersion: ArrayLike | None = None,
        withheld: str = "",
    ) -> LandingAssessment:
        """Rank landing sites on a map.

        Args:
            cells: The map message's content; points are never needed.
            area: (V, 2) polygon that the landing zone must lie in, map frame, m.
            keep_out: (V, 2) polygon that the zone must not touch.
            target: (2,) or (3,) place to be near to.
            dispersion: Deviations of the touchdown from its aim along x and y, m, and the lander's
                heading, rad, NaN for any; None for ``lss.dispersion``, and any.
            withheld: Why no site may be given out, however safe the ground, such as a keep-out
                that cannot be read; empty if nothing speaks against it.

        A polygon that crosses itself is inside where a ray to it crosses it an odd number of
        times. With one of fewer than three or not finite vertices, or a target that is not finite,
        nobody knows where landing is wanted: no site is given out and the explanation says why.
        """
        lss, domain = self.config.lss, cells.domain
        at = users_grid(domain, lss.grid_spacing)
        x, y = at.x, at.y
        wanted = Restrictions(area, keep_out, target, withheld)
        self._answers += 1
        spread = Dispersion.of(dispersion, lss)
        self._look_at(wanted)
        raster = rasterise(cells, lss.max_gap)
        if not raster.seen.any():
            reason = Reason.WITHHELD if withheld else Reason.NOTHING_MAPPED
            nowhere = np.full((len(y), len(x)), np.nan)
            nothing = Ground(x, y, np.isfinite(nowhere), nowhere)
            self._choose(nothing, lambda row, column: reason, reason)
            bits = at.any(touching(unknown_bits(raster)))
            return nothing_mapped(cells, self._answers, reason, x, y, bits)
        features = hazards.avoided_features(cells, lss)
        inside = seen_about(raster, lss)
        planes = planes_below(raster, lss)
        judged = self._judge.judge(raster, inside, planes.slope, spread)
        points = assess_points(cells, raster, planes, features, inside, judged.fails, lss)
        bits = points.hazard
        bits |= judged.uncertain * np.uint8(hazards.UNCERTAIN)
        safe = at.everywhere(points.safe)
        unsafe = at.linear(judged.aimed)
        score = np.where(safe, at.nearest(points.score), np.nan)
        # What sites are ranked by: the less the better.
        cost = unsafe + TIE * score / (1.0 + score) if judged.ranks else score
        unknown = wanted.apply(cost, x, y, lss)
        if judged.ranks:
            np.copyto(score, np.nan, where=np.isnan(cost))
        landable = bool(np.isfinite(cost).any())
        probability = 1.0 - unsafe
        explanation = f"{np.count_nonzero(safe)} of {safe.size} grid points are safe"
        if not safe.any():
            explanation = _why_none(points, raster, lss)
        elif not landable:
            explanation = "no safe ground within the landing area and outside the keep-out"
        if unknown:
            explanation = f"no site is given out: {unknown}"

        def why_not(row: int, column: int) -> Reason:
            if unknown:
                return Reason.WITHHELD
            if safe[row, column]:
                return wanted.why_not(x[column], y[row], lss)
            room = at.nearest(inside)[row, column] - lss.margin
            if room >= 0.5 * lss.vehicle_diameter - 1e-9:
                return Reason.HAZARD
            place = int(at.near[0][row]), int(at.near[1][column])
            unmapped = meets_unmapped(raster, *place, 0.5 * lss.vehicle_diameter + lss.margin, lss)
            return Reason.UNMAPPED if unmapped else Reason.UNSEEN

        none = Reason.WITHHELD if unknown else Reason.NO_SITE
        choice = self._choose(Ground(x, y, safe, cost), why_not, none)
        ranked = self._rank(cost, x, y)
        places = ranked if choice.place is None else [*ranked, choice.place]
        found = self._describe(points, judged, domain, at, (score, probability), places)
        hazard = at.any(bits)
        return LandingAssessment(
            stamp_ns=cells.stamp_ns,
            answer=self._answers,
            selected=self._selected(choice, found, cells, raster),
            pending=choice.place is None and landable,
            sites=found.of(slice(len(ranked))),
            x=x,
            y=y,
            hazard=hazard,
            safe=safe,
            score=score,
            probability=probability,
            risk=at.linear(judged.risk),
            explanation=explanation,
            offset_z=cells.offset_z,
            offset_variance=cells.offset_variance,
            ground=(at, raster, points),
        )

    def _look_at(self, wanted: Restrictions) -> None:
        """Another landing area without the target, or another place to be near to, elsewhere than
        the target is, asks for another one: guidance tells what it can still reach, and where it
        is going, again and again."""
        wish, before = wanted.wish(), self._wish
        self._wish = wish
        if before is None or wish == before:
            return
        held, lss = self._target.held, self.config.lss
        kept = held is not None
        if held is not None and wish[0] != before[0]:
            kept = wanted.area_holds(*held, lss)
        if held is not None and wish[1] != before[1]:
            kept &= wanted.is_near(*held, self._reach())
        if not kept:
            self.release()

    def _choose(self, ground: Ground, why_not: WhyNot, why_none: Reason) -> Choice:
        margin, reach = self.config.lss.switch_margin, self._reach()
        return self._target.choose(
            ground, margin=margin, reach=reach, why_not=why_not, why_none=why_none
        )

    def _reach(self) -> float:
        """How far from each other sites are the same, m: no two of a ranking are."""
        lss = self.config.lss
        return 0.49 * min(lss.vehicle_diameter, lss.min_separation)

    def _selected(
        self, choice: Choice, found: Sites, cells: CellMap, raster: TerrainRaster
    ) -> Selected:
        """The target, described in the last row of ``found``."""
        if choice.place is None:
            return no_target(choice.reason)
        site = replace(found.of(slice(-1, None)), id=np.array([choice.id], dtype=np.uint32))
        place_x, place_y, _ = site.position[0]
        radius = ground_radius(self.config.lss)
        covariance = ground_covariance(cells, raster, place_x, place_y, radius)
        return Selected(choice.reason, site, covariance)

    def _rank(self, cost: Array, x: Array, y: Array) -> list[tuple[int, int]]:
        """The best grid points, one after the other, each ``min_separation`` from those before."""
        lss = self.config.lss
        last = []
        if lss.hysteresis > 0.0:
            last = [grid_point(x, y, *place) for place in self._last_ranked]
        kept = [place for place in last if place is not None and np.isfinite(cost[place])]
        best = best_points(cost, x, y, lss.sites, lss.min_separation, kept, lss.hysteresis)
        ranked = [(int(row), int(column)) for row, column in zip(*best, strict=True)]
        self._last_ranked = [(float(x[column]), float(y[row])) for row, column in ranked]
        return ranked

    def _describe(
        self,
        points: PointAssessment,
        judged: Judgement,
        domain: Domain,
        at: GridSampler,
        layers: tuple[Array, Array],
        places: list[tuple[int, int]],
    ) -> Sites:
        """What is known of landing at grid points, given by row and column."""
        lss = self.config.lss
        where = tuple(np.array(places, dtype=np.intp).reshape(-1, 2).T)
        place = np.column_stack([at.x[where[1]], at.y[where[0]]])
        centre = at.lattice(*where)
        rough, raised = greatest_about(points, *centre)
        planes, zone = points.planes, 0.5 * lss.vehicle_diameter + lss.margin
        along_x, along_y = planes.slope_x[centre], planes.slope_y[centre]
        normal = np.column_stack([-along_x, -along_y, np.ones_like(along_x)])
        sites = Sites(
            position=np.column_stack([place, at.linear(planes.elevation)[where]]),
            normal=normal / np.linalg.norm(normal, axis=1, keepdims=True),
            score=layers[0][where],
            probability=layers[1][where],
            slope_deg=np.degrees(planes.slope[centre]),
            roughness=rough,
            hazard_distance=room_about(points, domain, zone, place[:, 0], place[:, 1]),
            subscale_height=raised,
            id=self._target.places.numbers(place, self._reach()),
            reasons=(),
        )
        raster, radius = points.raster, 0.5 * lss.vehicle_diameter

        def unmapped(row: int, column: int) -> bool:
            return meets_unmapped(raster, row, column, radius, lss)

        return with_reasons(sites, lss, judged.remainders(*centre, unmapped))


def _why_none(points: PointAssessment, raster: TerrainRaster, lss: LssConfig) -> str:
    seen, unmapped = float(np.mean(raster.seen)), float(np.mean(raster.unmapped))
    hazardous = (points.hazard & hazards.IDENTIFIED > 0) & (points.hazard & hazards.UNSEEN == 0)
    return (
        f"no safe site: {100.0 * seen:.0f} % of the domain is seen, "
        + (f"{100.0 * unmapped:.0f} % seen but not yet mapped, " if unmapped > 0.0 else "")
        + f"{100.0 * float(np.mean(hazardous)):.0f} % shows a hazard, and no zone of "
        f"{0.5 * lss.vehicle_diameter + lss.margin:.2f} m radius is both seen and safe"
    )
