# SPDX-License-Identifier: Apache-2.0
"""The result of an assessment: sites, the target, the grid and warnings about the risks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from quadtree_lss.onboard.arrays import Array, Bytes, Mask, Numbers
from quadtree_lss.onboard.config.risk import doubt
from quadtree_lss.onboard.config.settings import Config, LssConfig
from quadtree_lss.onboard.core.landing import hazards
from quadtree_lss.onboard.core.landing.grid import GridSampler
from quadtree_lss.onboard.core.landing.probability import shown
from quadtree_lss.onboard.core.landing.raster import TerrainRaster
from quadtree_lss.onboard.core.landing.score import PointAssessment
from quadtree_lss.onboard.core.landing.target import SETTLE_SHARE, Reason, State
from quadtree_lss.onboard.core.tree.cell_map import CellMap

#: Greatest share of the judged ground without a return: flights that were fitted have up to 0.02.
MOST_BRIDGED = 0.05


@dataclass(frozen=True, repr=False)
class Sites:
    """Ranked sites, best first; K rows, map frame.

    Attributes:
        position: (K, 3) on the plane of the ground at the lander's scale, where its pads rest, m.
        normal: (K, 3) of that plane.
        score: (K,) mean score density over the zone (Eq. 59), lower is better.
        probability: (K,) of a safe touchdown if the lander aims there; NaN if it is not asked for.
        slope_deg: (K,) at the lander's scale.
        roughness: (K,) greatest mean deviation from the plane beyond noise in the zone: Eq. 55's
            volume over the leaf's area, m.
        hazard_distance: (K,) how far the zone may move in any direction until it touches a hazard
            or unseen ground, m; see ``score.room_about``.
        subscale_height: (K,) greatest height of a subscale feature in the zone, m.
        id: (K,) number of its place, which lasts as long as landing there is permitted (see
            ``target.Places``).
        reasons: A sentence for each.
    """

    position: Array
    normal: Array
    score: Array
    probability: Array
    slope_deg: Array
    roughness: Array
    hazard_distance: Array
    subscale_height: Array
    id: Numbers
    reasons: tuple[str, ...]

    def of(self, rows: slice) -> Sites:
        """Some of them."""
        return Sites(*(getattr(self, column.name)[rows] for column in fields(self)))

    def columns(self) -> dict[str, Any]:
        """Columns by name as in ``sites.csv``, and the ``reason`` of each site."""
        places = {axis: self.position[:, k] for k, axis in enumerate("xyz")}
        normals = {f"n{axis}": self.normal[:, k] for k, axis in enumerate("xyz")}
        names = "score slope_deg roughness hazard_distance subscale_height id probability".split()
        values = {name: getattr(self, name) for name in names}
        rank = np.arange(1, len(self) + 1)
        return {"rank": rank, **places, **normals, **values, "reason": list(self.reasons)}

    def to_dataframe(self) -> Any:
        """Return the columns as a ``pandas.DataFrame``; pandas must be installed."""
        import pandas  # type: ignore[import-untyped]

        return pandas.DataFrame(self.columns())

    def _repr_html_(self) -> str:
        """Return a table for notebooks."""
        shown = {"x": ".2f", "y": ".2f", "z": ".2f", "probability": ".4f", "slope_deg": ".1f"}
        shown |= {"hazard_distance": ".1f", "reason": ""}
        columns = self.columns()
        head = "".join(f"<th>{name}</th>" for name in ("rank", *shown))
        rows = "".join(
            f"<tr><td>{k + 1}</td>"
            + "".join(f"<td>{format(columns[name][k], form)}</td>" for name, form in shown.items())
            + "</tr>"
            for k in range(len(self))
        )
        return f"<table><tr>{head}</tr>{rows}</table>"

    def __len__(self) -> int:
        return len(self.score)

    def __repr__(self) -> str:
        if not len(self):
            return "<Sites: none>"
        x, y, z = self.position[0]
        return f"<Sites: {len(self)}, the best at x {x:.2f}, y {y:.2f}, z {z:.2f} m>"


@dataclass(frozen=True)
class Selected:
    """The target to fly to, or why there is none.

    Attributes:
        reason: Why it is this one, or why there is none.
        state: What is going on.
        probability: Of a safe touchdown if the lander aims there; without a target, at the best
            place that is permitted; NaN if there is none, or nobody asked for it.
        site: One row, none if there is no target.
        covariance: (6, 6) of x, y, z and rotations about fixed axes, map frame; see
            ``covariance.ground_covariance``. NaN if there is no target.
    """

    reason: Reason
    state: State
    probability: float
    site: Sites
    covariance: Array

    @property
    def id(self) -> int:
        """Number of its place, 0 if there is no target."""
        return int(self.site.id[0]) if len(self.site.id) else 0

    @property
    def position(self) -> Array:
        """(3,) m, NaN if there is no target."""
        return self.site.position[0] if self.id else np.full(3, np.nan)


@dataclass(frozen=True, repr=False)
class LandingAssessment:
    """Where the map allows landing.

    Attributes:
        stamp_ns: The map's stamp.
        number: Of the assessment, from 1: no two of a selector have the same.
        selected: The target that holds from assessment to assessment.
        seen: Share of the area, or without one of the domain, of which the ground is known.
        pending: There is no target, but another assessment, be it of the same map, would give one.
        sites: Ranked sites, none if no ground is safe.
        now: (4,) x, y, z, m, and probability of a safe touchdown, as of ``probability``: the best
            place within reach at this moment (see `grid.within_reach`), NaN if there is none.
        x, y: (nx,), (ny,) of the grid points, m.
        hazard: (ny, nx) bits 1 slope, 2 elevation, 4 exception, 8 touchdown (a touchdown here, or
            within ``lss.margin``, fails or has too great a risk), 16 uncertain (its risk is the
            only reason: the lander stands on the map), 32 unobserved ground under the vehicle, 64
            observed but not estimated (128 too), 128 unobserved. Landing is allowed exactly where
            none of 8, 32 and 128 is set; with the paper's rules also 1, 2 and 4 exclude.
        safe: (ny, nx) landing centred here is allowed by the ground itself.
        score: (ny, nx) Eq. 59, NaN where excluded (unsafe, keep-out, outside the landing area).
        probability: (ny, nx) of a safe touchdown if the lander aims there, with the dispersion.
        risk: (ny, nx) that landing right there fails, with the ground as it is known; both NaN if
            nobody asked for them.
        explanation: Why there are no sites, or how many grid points are safe.
        warnings: Reasons why the risks may be wrong, one line each (see `risk_warnings`).
        offset_z, offset_variance: Of the map from navigation, as of ``CellMap``, m, m^2.
        ground: What the layers below are made of when they are asked for.
    """

    stamp_ns: int
    number: int
    selected: Selected
    seen: float
    pending: bool
    sites: Sites
    now: Array
    x: Array
    y: Array
    hazard: Bytes
    safe: Mask
    score: Array
    probability: Array
    risk: Array
    explanation: str
    offset_z: float
    offset_variance: float
    ground: tuple[GridSampler, PointAssessment] | None = None
    warnings: tuple[str, ...] = ()
    lss: LssConfig | None = None

    @property
    def why(self) -> str:
        """Return why the target is this one, or why there is none, in one sentence."""
        chosen = self.selected
        if not chosen.id:
            return f"no target: {self._why_none()}"
        why, aims = chosen.reason.text, self.sites
        if chosen.state is State.COMMITTED and chosen.reason is Reason.HOLDS:
            why = "the vehicle is committed to it"
        elif chosen.reason is Reason.HOLDS and len(aims) and aims.id[0] != chosen.id:
            away = float(np.hypot(*(aims.position[0] - chosen.position)[:2]))
            why = f"site 1 ({shown(aims.probability[0])}, {away:.1f} m away) gains less than the"
            why += " divert costs"
        return f"target {chosen.id} ({shown(chosen.probability)}): {why}"

    def _why_none(self) -> str:
        reason, lss = self.selected.reason, self.lss
        if reason is Reason.SETTLING:
            return f"{self.seen:.0%} is observed, required {SETTLE_SHARE:.0%}"
        if lss is not None and reason is Reason.UNLIKELY:
            best, least = shown(self.selected.probability), 100.0 * lss.min_probability
            return f"best grid point {best}, required {least:g} %"
        observed = np.where(self.hazard & hazards.UNSEEN == 0, self.probability, np.nan)
        if lss is None or reason is not Reason.NO_SITE or np.isnan(observed).all():
            return reason.text or self.explanation.partition(": ")[2] or self.explanation
        if self.safe.any():
            return self.explanation
        best = f"best grid point {shown(float(np.nanmax(observed)))}, but none has a risk"
        return f"{best} of at most {100.0 * lss.max_risk:g} % and {lss.margin:g} m of margin"

    @property
    def undecided(self) -> bool:
        """Whether there is a target will be decided: more is to be seen, or seen again, first."""
        return self.selected.reason in (Reason.UNCONFIRMED, Reason.SETTLING)

    def __repr__(self) -> str:
        ny, nx = self.score.shape
        return f"<LandingAssessment: {nx} x {ny} grid points; {self.explanation}; {self.sites}>"

    def _repr_html_(self) -> str:
        """Return the explanation and the table of sites for notebooks."""
        return f"<p>{self.explanation}</p>{self.sites._repr_html_()}"

    def _layer(self, values: Callable[..., Array]) -> Array:
        out = np.full(self.score.shape, np.nan)
        if self.ground is not None:
            np.copyto(out, values(*self.ground), where=self.hazard & hazards.UNSEEN == 0)
        return out

    @cached_property
    def elevation(self) -> Array:
        """(ny, nx) height of the map's own planes at the grid point, m, NaN if unseen."""
        return self._layer(lambda at, points: at.ground(points.raster))

    @cached_property
    def plane_elevation(self) -> Array:
        """(ny, nx) height of the plane at the lander's scale there, m, NaN if unseen."""
        return self._layer(lambda at, points: at.linear(points.around.planes.elevation))

    @cached_property
    def slope_deg(self) -> Array:
        """(ny, nx) slope at the lander's scale, NaN if unseen."""
        return self._layer(
            lambda at, points: np.degrees(np.arctan(at.nearest(points.around.planes.gradient)))
        )


def no_target(
    reason: Reason, state: State = State.NONE, probability: float = float("nan")
) -> Selected:
    """There is none."""
    return Selected(reason, state, probability, no_sites(), np.full((6, 6), np.nan))


def no_sites() -> Sites:
    """Not one."""
    none = np.zeros(0)
    number = np.zeros(0, dtype=np.uint32)
    return Sites(np.zeros((0, 3)), np.zeros((0, 3)), *(none,) * 6, number, ())


def nothing_mapped(
    cells: CellMap, number: int, reason: Reason, x: Array, y: Array, hazard: Bytes
) -> LandingAssessment:
    """The assessment of a map of which nothing is known."""
    shape = (len(y), len(x))
    return LandingAssessment(
        stamp_ns=cells.stamp_ns,
        number=number,
        selected=no_target(reason),
        seen=0.0,
        pending=False,
        sites=no_sites(),
        now=np.full(4, np.nan),
        x=x,
        y=y,
        hazard=hazard,
        safe=np.zeros(shape, dtype=np.bool_),
        score=np.full(shape, np.nan),
        probability=np.zeros(shape),
        risk=np.ones(shape),
        explanation="nothing is mapped yet",
        offset_z=cells.offset_z,
        offset_variance=cells.offset_variance,
    )


def risk_warnings(config: Config, raster: TerrainRaster, judged: Mask) -> tuple[str, ...]:
    """List why the predicted risks may be wrong, one line per reason.

    ``judged``: (n + 1, n + 1) grid points at which the risk is known.
    """
    return tuple(filter(None, (doubt(config), coverage(raster, judged))))


def coverage(raster: TerrainRaster, judged: Mask) -> str:
    """Return a warning if the judged ground has fewer returns than that of the fit, or ""."""
    judged = judged[1:, 1:]
    share = np.count_nonzero(raster.bridged & judged) / (np.count_nonzero(judged) or 1)
    if share <= MOST_BRIDGED:
        return ""
    return (
        f"{100.0 * share:.0f} % of the judged ground has no return and is bridged: the risk was"
        f" fitted where at most {100.0 * MOST_BRIDGED:.0f} % is"
    )
