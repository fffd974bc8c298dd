# SPDX-License-Identifier: Apache-2.0
"""Landing sites: what may be landed on, how good it is, and the best of it (paper V.D)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadtree_lss.config.settings import Config, LssConfig
from quadtree_lss.core.geometry.polygons import signed_distance
from quadtree_lss.core.landing import hazards
from quadtree_lss.core.landing.grid import GridSampler, best_points, grid_axis
from quadtree_lss.core.landing.raster import TerrainRaster, rasterise
from quadtree_lss.core.landing.score import (
    PointAssessment,
    assess_points,
    greatest_in_zones,
    room_about,
    seen_about,
)
from quadtree_lss.core.landing.touchdown import TouchdownCheck
from quadtree_lss.core.tree.cell_map import CellMap
from quadtree_lss.core.tree.domain import Domain

Array = NDArray[np.float64]
Bits = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class Sites:
    """Ranked sites, best first; K rows, map frame.

    Attributes:
        position: (K, 3) on the plane of the ground at the lander's scale, where its pads rest, m.
        normal: (K, 3) of that plane.
        score: (K,) mean score density over the zone (Eq. 59), lower is better.
        slope_deg: (K,) at the lander's scale.
        roughness: (K,) greatest mean deviation from the plane beyond noise in the zone: Eq. 55's
            volume over the leaf's area, m.
        hazard_distance: (K,) how far the zone may move in any direction until it touches a hazard
            or unseen ground, m; see ``score.room_about``.
        subscale_height: (K,) greatest height of a subscale feature in the zone, m.
        reasons: A sentence for each.
    """

    position: Array
    normal: Array
    score: Array
    slope_deg: Array
    roughness: Array
    hazard_distance: Array
    subscale_height: Array
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class LandingAssessment:
    """Where the map allows landing.

    Attributes:
        stamp_ns: The map's stamp.
        sites: Ranked sites, none if no ground is safe.
        x, y: (nx,), (ny,) of the grid points, m.
        elevation: (ny, nx) height of the map's own planes at the grid point, m, NaN if unseen.
        plane_elevation: (ny, nx) of the plane at the lander's scale there, m, NaN if unseen.
        slope_deg: (ny, nx) slope at the lander's scale, NaN if unseen.
        hazard: (ny, nx) bits 1 slope, 2 elevation, 4 exception, 8 touchdown, 128 unseen.
        safe: (ny, nx) landing centred here is allowed by the ground itself.
        score: (ny, nx) Eq. 59, NaN where excluded (unsafe, keep-out, outside the landing area).
        explanation: Why there are no sites, or how many grid points are safe.
    """

    stamp_ns: int
    sites: Sites
    x: Array
    y: Array
    elevation: Array
    plane_elevation: Array
    slope_deg: Array
    hazard: Bits
    safe: Mask
    score: Array
    explanation: str


class LandingSiteSelector:
    """Assesses maps.

    Keeps the last first-ranked site, for ``lss.hysteresis``, and the verdicts of the touchdown
    check, to repeat only what changed.
    """

    def __init__(self, config: Config) -> None:
        self._last_first: Array | None = None
        # What glibc has freed once in this size it keeps: the arrays of a map need not be got
        # from the system, page by page, for every map.
        np.empty(31 << 20, dtype=np.uint8)
        self.configure(config)

    def configure(self, config: Config) -> None:
        """Go by these limits from now on; what was found by others is forgotten."""
        self.config = config
        self._touchdown = TouchdownCheck(config.lss)

    def assess(
        self,
        cells: CellMap,
        *,
        area: ArrayLike | None = None,
        keep_out: ArrayLike | None = None,
        target: ArrayLike | None = None,
        withheld: str = "",
    ) -> LandingAssessment:
        """Rank landing sites on a map.

        Args:
            cells: The map message's content; points are never needed.
            area: (V, 2) polygon that the landing zone must lie in, map frame, m.
            keep_out: (V, 2) polygon that the zone must not touch.
            target: (2,) or (3,) place to be near to.
            withheld: Why no site may be given out, however safe the ground, such as a keep-out
                that cannot be read; empty if nothing speaks against it.

        A polygon that crosses itself is inside where a ray to it crosses it an odd number of
        times. With one of fewer than three or not finite vertices, or a target that is not finite,
        nobody knows where landing is wanted: no site is given out and the explanation says why.
        """
        lss, domain = self.config.lss, cells.domain
        x, y = (grid_axis(low, domain.size, lss.grid_spacing) for low in (domain.xmin, domain.ymin))
        raster = rasterise(cells, lss.max_gap)
        if not raster.seen.any():
            return _nothing(cells.stamp_ns, x, y, "nothing is mapped yet")
        features = hazards.avoided_features(cells, lss)
        inside = seen_about(raster)
        fails = self._fails_at_touchdown(raster, inside)
        points = assess_points(cells, raster, features, inside, fails, lss)
        at = GridSampler(domain, x, y)
        safe = at.everywhere(points.safe)
        score = np.where(safe, at.nearest(points.score), np.nan)
        explanation = f"{np.count_nonzero(safe)} of {safe.size} grid points are safe"
        if not safe.any():
            explanation = _why_none(points, raster, lss)
        try:
            _restrict(score, x, y, lss, area, keep_out, target)
        except (TypeError, ValueError) as error:
            score[...] = np.nan
            explanation = f"no site is given out: {error}"
        else:
            if safe.any() and not np.isfinite(score).any():
                explanation = "no safe ground within the landing area and outside the keep-out"
        if withheld:
            score[...] = np.nan
            explanation = f"no site is given out: {withheld}"
        sites = self._rank(points, domain, at, score, x, y)
        hazard = at.any(points.hazard)
        unseen = (hazard & hazards.UNSEEN) > 0
        return LandingAssessment(
            stamp_ns=cells.stamp_ns,
            sites=sites,
            x=x,
            y=y,
            elevation=np.where(unseen, np.nan, at.ground(raster)),
            plane_elevation=np.where(unseen, np.nan, at.linear(points.planes.elevation)),
            slope_deg=np.where(unseen, np.nan, np.degrees(at.nearest(points.slope))),
            hazard=hazard,
            safe=safe,
            score=score,
            explanation=explanation,
        )

    def _fails_at_touchdown(self, raster: TerrainRaster, inside: Array) -> Mask:
        """Where the lander fails, (n + 1, n + 1), of where all ground under it is seen."""
        lss = self.config.lss
        candidates = inside >= 0.5 * lss.vehicle_diameter - 1e-9
        if lss.assessment != "touchdown" or not candidates.any():
            return np.zeros(inside.shape, dtype=np.bool_)
        return self._touchdown.unsafe(raster, candidates)

    def _rank(
        self,
        points: PointAssessment,
        domain: Domain,
        at: GridSampler,
        score: Array,
        x: Array,
        y: Array,
    ) -> Sites:
        """The best grid points, one after the other, each ``min_separation`` from those before."""
        lss = self.config.lss
        first = self._keep_first(score, x, y)
        where = best_points(score, x, y, lss.sites, lss.min_separation, first)
        place = np.column_stack([x[where[1]], y[where[0]]])
        self._last_first = place[0].copy() if len(place) else None
        centre = at.lattice(*where)
        planes, zone = points.planes, 0.5 * lss.vehicle_diameter + lss.margin
        along_x, along_y = planes.slope_x[centre], planes.slope_y[centre]
        normal = np.column_stack([-along_x, -along_y, np.ones_like(along_x)])
        sites = Sites(
            position=np.column_stack([place, at.linear(planes.elevation)[where]]),
            normal=normal / np.linalg.norm(normal, axis=1, keepdims=True),
            score=score[where],
            slope_deg=np.degrees(points.slope[centre]),
            roughness=greatest_in_zones(points.roughness, points.zone, *centre),
            hazard_distance=room_about(points, domain, zone, place[:, 0], place[:, 1]),
            subscale_height=greatest_in_zones(points.subscale, points.zone, *centre),
            reasons=(),
        )
        return _with_reasons(sites, lss)

    def _keep_first(self, score: Array, x: Array, y: Array) -> tuple[int, int] | None:
        """Hysteresis: the last first site, while it is allowed and not worse by the set score."""
        lss = self.config.lss
        if lss.hysteresis <= 0.0 or self._last_first is None:
            return None
        column = np.flatnonzero(x == self._last_first[0])
        row = np.flatnonzero(y == self._last_first[1])
        if not (len(row) and len(column) and np.isfinite(score[row[0], column[0]])):
            return None
        if score[row[0], column[0]] - np.nanmin(score) > lss.hysteresis:
            return None
        return int(row[0]), int(column[0])


def _restrict(
    score: Array,
    x: Array,
    y: Array,
    lss: LssConfig,
    area: ArrayLike | None,
    keep_out: ArrayLike | None,
    target: ArrayLike | None,
) -> None:
    """Exclude grid points (ny, nx) by area and keep-out and add what the way to the target costs.

    Raises:
        ValueError, TypeError: a polygon with fewer than three finite vertices, a target that is
            not finite, or not numbers.
    """
    if area is None and keep_out is None and target is None:
        return
    zone = 0.5 * lss.vehicle_diameter + lss.margin
    grid_x, grid_y = np.meshgrid(x, y)
    if area is not None:
        score[signed_distance(area, grid_x, grid_y) < zone] = np.nan
    if keep_out is not None:
        score[signed_distance(keep_out, grid_x, grid_y) > -zone] = np.nan
    if target is not None:
        goal = np.asarray(target, dtype=np.float64)
        if goal.shape not in ((2,), (3,)) or not np.isfinite(goal[:2]).all():
            msg = f"a landing target needs two or three finite coordinates, got {target!r}"
            raise ValueError(msg)
        score += lss.weight_target * np.hypot(grid_x - goal[0], grid_y - goal[1])


def _with_reasons(sites: Sites, lss: LssConfig) -> Sites:
    """A sentence for each site: its figures, and the slope limit that decided."""
    lines = []
    touchdown = lss.assessment == "touchdown"
    limit = lss.touchdown_slope_deg if touchdown else lss.max_slope_deg
    for k in range(len(sites.score)):
        clear = sites.hazard_distance[k]
        nearest = f"{clear:.1f} m clear of hazards and unseen ground"
        feature = sites.subscale_height[k]
        lines.append(
            f"slope {sites.slope_deg[k]:.1f} deg of {limit:g}, {nearest}, "
            f"roughness {sites.roughness[k]:.3f} m, "
            + (f"features up to {feature:.2f} m" if feature >= 0.005 else "no subscale feature")
        )
    return replace(sites, reasons=tuple(lines))


def _why_none(points: PointAssessment, raster: TerrainRaster, lss: LssConfig) -> str:
    seen = float(np.mean(raster.seen))
    hazardous = (points.hazard & 0x7F > 0) & (points.hazard & hazards.UNSEEN == 0)
    return (
        f"no safe site: {100.0 * seen:.0f} % of the domain is seen, "
        f"{100.0 * float(np.mean(hazardous)):.0f} % shows a hazard, and no zone of "
        f"{0.5 * lss.vehicle_diameter + lss.margin:.2f} m radius is both seen and safe"
    )


def _nothing(stamp_ns: int, x: Array, y: Array, explanation: str) -> LandingAssessment:
    """The assessment of a map without a measurement."""
    shape = (len(y), len(x))
    none = np.zeros(0)
    sites = Sites(np.zeros((0, 3)), np.zeros((0, 3)), none, none, none, none, none, ())
    return LandingAssessment(
        stamp_ns=stamp_ns,
        sites=sites,
        x=x,
        y=y,
        elevation=np.full(shape, np.nan),
        plane_elevation=np.full(shape, np.nan),
        slope_deg=np.full(shape, np.nan),
        hazard=np.full(shape, hazards.UNSEEN, dtype=np.uint8),
        safe=np.zeros(shape, dtype=np.bool_),
        score=np.full(shape, np.nan),
        explanation=explanation,
    )
