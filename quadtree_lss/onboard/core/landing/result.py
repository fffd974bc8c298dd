# SPDX-License-Identifier: Apache-2.0
"""Results of an assessment: ranked sites, the target and the grid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import cached_property
from math import isnan
from typing import TYPE_CHECKING, Any

import numpy as np

from quadtree_lss.onboard.arrays import Array, Bytes, Mask, Numbers
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing import hazards
from quadtree_lss.onboard.core.landing.target import SETTLE_SHARE, Reason, State

if TYPE_CHECKING:
    from quadtree_lss.onboard.core.landing.aim import GridSampler
    from quadtree_lss.onboard.core.landing.score import PointAssessment


def shown(probability: float) -> str:
    """Format a probability in per cent, with more digits near certainty; never 100 %."""
    if isnan(probability):
        return "-"
    share = 100.0 * min(probability, 0.9999)
    return f"{share:.2f} %" if share >= 99.85 else f"{share:.1f} %"


@dataclass(frozen=True, repr=False)
class Sites:
    """Ranked sites, best first; K rows, map frame.

    Attributes:
        position: (K, 3) on the plane of the ground at the vehicle's scale, m.
        normal: (K, 3) of that plane.
        score: (K,) mean score density over the zone (Eq. 59), lower is better.
        probability: (K,) probability of success of the aim point; NaN without a risk model.
        slope_deg: (K,) at the vehicle's scale.
        roughness: (K,) greatest roughness in the zone: Eq. 55's volume over the leaf's area, m.
        hazard_distance: (K,) how far the zone can move in any direction until it touches a hazard
            or unobserved ground, m.
        subscale_height: (K,) greatest height of a subscale feature in the zone, m.
        id: (K,) number of the site (see `target.SiteNumbers`).
        reasons: One sentence per site.
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

    def __getitem__(self, rows: slice) -> Sites:
        return Sites(*(getattr(self, column.name)[rows] for column in fields(self)))

    def columns(self) -> dict[str, Any]:
        """Return the columns of ``sites.csv`` by name, and the ``reason`` of each site."""
        vectors = np.hstack([self.position, self.normal]).T
        places = dict(zip("x y z nx ny nz".split(), vectors, strict=True))
        names = "score slope_deg roughness hazard_distance subscale_height id probability".split()
        values = {name: getattr(self, name) for name in names}
        rank = np.arange(1, len(self) + 1)
        return {"rank": rank, **places, **values, "reason": list(self.reasons)}

    def to_dataframe(self) -> Any:
        """Return the columns as a ``pandas.DataFrame``; pandas must be installed."""
        import pandas  # type: ignore[import-untyped]

        return pandas.DataFrame(self.columns())

    def __len__(self) -> int:
        return len(self.score)

    def __repr__(self) -> str:
        if not len(self):
            return "<Sites: none>"
        x, y, z = self.position[0]
        return f"<Sites: {len(self)}, the best at x {x:.2f}, y {y:.2f}, z {z:.2f} m>"


def no_sites() -> Sites:
    """Return an empty ranking."""
    none = np.zeros(0)
    number = np.zeros(0, dtype=np.uint32)
    return Sites(np.zeros((0, 3)), np.zeros((0, 3)), *(none,) * 6, number, ())


@dataclass(frozen=True)
class Selected:
    """The target, or the reason why there is none.

    Attributes:
        reason: Of the choice, or why there is no target.
        state: State of the target.
        probability: Probability of success of the target, or without one of the best permitted
            grid point; NaN without either, or without a risk model.
        site: One row, none without a target.
        covariance: (6, 6) of x, y, z and rotations about fixed axes, map frame (see
            `choose.ground_covariance`); NaN without a target.
    """

    reason: Reason
    state: State
    probability: float
    site: Sites
    covariance: Array

    @property
    def id(self) -> int:
        """Number of the site, 0 without a target."""
        return int(self.site.id[0]) if len(self.site.id) else 0

    @property
    def position(self) -> Array:
        """(3,) m, NaN without a target."""
        return self.site.position[0] if self.id else np.full(3, np.nan)


@dataclass(frozen=True, repr=False, kw_only=True)
class LandingAssessment:
    """Result of an assessment.

    Attributes:
        stamp_ns: Stamp of the map.
        number: Number of the assessment since the selector was made, from 1.
        selected: The target, which is kept from assessment to assessment.
        seen: Observed share of the landing area, or without one of the domain.
        pending: There is no target, but another assessment of the same map would give one.
        sites: Ranked sites, none if no ground is safe.
        now: (4,) x, y, z, m, and probability of success of the best aim point within reach at this
            moment (see `aim.within_reach`), NaN without one.
        x, y: (nx,), (ny,) of the grid points, m.
        hazard: (ny, nx) bits 1 slope, 2 elevation, 4 exception, 8 touchdown (a touchdown here, or
            within ``lss.margin``, fails or has too great a risk), 16 uncertain (the risk is too
            great, but the contact on the map is within the limits), 32 unobserved ground under the
            vehicle, 64 observed but not estimated (128 is set, too), 128 unobserved. Landing is
            allowed exactly where none of 8, 32 and 128 is set, and with the paper's rules none of
            1, 2 and 4.
        safe: (ny, nx) the ground allows landing centred here.
        score: (ny, nx) Eq. 59, NaN where excluded (unsafe, keep-out, outside the landing area).
        probability: (ny, nx) probability of success of the aim point, with the dispersion.
        risk: (ny, nx) predicted risk; both NaN without a risk model.
        explanation: Why there are no sites, or how many grid points are safe.
        offset_z, offset_variance: As in ``CellMap``, m, m^2.
        terrain: Sources of the layers `elevation`, `plane_elevation` and `slope_deg`.
        warnings: Why the risks may be wrong (see `risk.risk_warnings`).
        lss: Settings of the assessment.
    """

    stamp_ns: int
    number: int
    selected: Selected
    seen: float = 0.0
    pending: bool = False
    sites: Sites = field(default_factory=no_sites)
    now: Array = field(default_factory=lambda: np.full(4, np.nan))
    x: Array
    y: Array
    hazard: Bytes
    safe: Mask
    score: Array
    probability: Array
    risk: Array
    explanation: str = "nothing is mapped yet"
    offset_z: float
    offset_variance: float
    lss: LssConfig
    terrain: tuple[GridSampler, PointAssessment] | None = None
    warnings: tuple[str, ...] = ()

    @property
    def why(self) -> str:
        """Return why the target is this one, or why there is none, in one sentence."""
        selected = self.selected
        if not selected.id:
            return f"no target: {self._why_no_target()}"
        why, sites = selected.reason.text, self.sites
        if selected.state is State.COMMITTED and selected.reason is Reason.HOLDS:
            why = "the vehicle is committed to it"
        elif selected.reason is Reason.HOLDS and len(sites) and sites.id[0] != selected.id:
            away = float(np.hypot(*(sites.position[0] - selected.position)[:2]))
            why = f"site 1 ({shown(sites.probability[0])}, {away:.1f} m away) gains less than the"
            why += " divert costs"
        return f"target {selected.id} ({shown(selected.probability)}): {why}"

    def _why_no_target(self) -> str:
        reason, lss = self.selected.reason, self.lss
        if reason is Reason.SETTLING:
            return f"{self.seen:.0%} is observed, required {SETTLE_SHARE:.0%}"
        if reason is Reason.UNLIKELY:
            required = 100.0 * lss.min_probability
            return f"best grid point {shown(self.selected.probability)}, required {required:g} %"
        observed = np.where(self.hazard & hazards.UNSEEN == 0, self.probability, np.nan)
        if reason is not Reason.NO_SITE or np.isnan(observed).all():
            return reason.text or self.explanation.partition(": ")[2] or self.explanation
        if self.safe.any():
            return self.explanation
        best = f"best grid point {shown(float(np.nanmax(observed)))}, but none has a risk"
        return f"{best} of at most {100.0 * lss.max_risk:g} % and {lss.margin:g} m of margin"

    @property
    def undecided(self) -> bool:
        """Return whether the target depends on further observations."""
        return self.selected.reason in (Reason.UNCONFIRMED, Reason.SETTLING)

    def __repr__(self) -> str:
        ny, nx = self.score.shape
        return f"<LandingAssessment: {nx} x {ny} grid points; {self.explanation}; {self.sites}>"

    def _layer(self, compute: Callable[[GridSampler, PointAssessment], Array]) -> Array:
        out = np.full(self.score.shape, np.nan)
        if self.terrain is not None:
            np.copyto(out, compute(*self.terrain), where=self.hazard & hazards.UNSEEN == 0)
        return out

    @cached_property
    def elevation(self) -> Array:
        """(ny, nx) height of the leaves' planes at the grid point, m, NaN if unobserved."""
        return self._layer(lambda sampler, points: sampler.leaf_elevation(points.raster))

    @cached_property
    def plane_elevation(self) -> Array:
        """(ny, nx) height of the plane at the vehicle's scale, m, NaN if unobserved."""
        return self._layer(lambda sampler, points: sampler.linear(points.raster.planes.elevation))

    @cached_property
    def slope_deg(self) -> Array:
        """(ny, nx) slope at the vehicle's scale, NaN if unobserved."""
        planes = self._layer(lambda sampler, points: sampler.nearest(points.raster.planes.gradient))
        return np.degrees(np.arctan(planes))


def no_target(
    reason: Reason, state: State = State.NONE, probability: float = float("nan")
) -> Selected:
    """Return the result without a target."""
    return Selected(reason, state, probability, no_sites(), np.full((6, 6), np.nan))
