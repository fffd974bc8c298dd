# SPDX-License-Identifier: Apache-2.0
"""The landing target: selection, changes and their reasons.

`Situation.transition` is the transition function of a state machine whose states are `State`. The
target changes to the grid point that ranks first after the divert's cost if the expected gain
exceeds that cost (docs/landing.md):

    S (c(target) - c) > C / (1 - d / r),    d < r

c is the cost of a grid point, S and C are `GAIN_AND_COST`, d is the distance between the two
points, m, and r is the reach of the vehicle above ``lss.commit_height`` (`Descent.reach`), m.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum, IntEnum
from functools import cached_property
from math import dist, inf, nan
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from quadtree_lss.onboard.arrays import Mask
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing.ranking import Candidates, GridIndex

if TYPE_CHECKING:
    from quadtree_lss.onboard.core.landing.restrictions import Restrictions

#: Most numbered sites; the oldest are dropped first.
MAX_SITES = 1000
#: (S, C) by ranking. S: true gain as a share of the predicted gain of the grid point that ranks
#: first, which is the best of many predictions with errors (benchmark/target.py --bias). C: least
#: cost of a divert: in probability, because a third of a predicted gain below 0.004 is true; in the
#: score 4 m more clearance or 4.6 degrees less slope.
GAIN_AND_COST = {"probability": (0.5, 0.002), "score": (1.0, 0.08)}
#: A target on ground that is no longer safe is kept while the risk within half of ``lss.margin`` is
#: at most this multiple of ``lss.max_risk``: the edge of small safe areas moves with each scan.
KEEP_RISK_FACTOR = 3.0
#: Share of the area, or of the domain, that is observed before the first target, unless
#: ``lss.settle_time`` is over: the first survey of a closed loop observes it (config/flight.yaml).
SETTLE_SHARE = 0.63
#: Cost per metre of distance to the preferred point, so that the nearer of two equal sites ranks
#: first: 0.1 % of probability, or in the score 0.2 m of clearance.
DISTANCE_COST = {"probability": 0.001, "score": 0.004}
#: Lateral acceleration of the vehicle, m/s^2, and least downward speed for the time left, m/s.
LATERAL_ACCELERATION, MIN_DESCENT_SPEED = 1.0, 0.5


class Reason(IntEnum):
    """Why the target is this one (below 16), or why there is none, and the sentence for it, unless
    it needs figures (`result.LandingAssessment.why`)."""

    text: str

    def __new__(cls, value: int, text: str) -> Reason:
        reason = int.__new__(cls, value)
        reason._value_, reason.text = value, text
        return reason

    HOLDS = 0, "no grid point gains more than a divert costs"
    FIRST = 1, "first choice"
    BETTER = 2, "gains more than the divert costs"
    RELEASED = 3, "chosen again on request"
    LAND_NOW = 4, "best within reach, on request"
    NOTHING_MAPPED = 16, "nothing is mapped yet"
    NO_SITE = 17, ""
    HAZARD = 18, "its ground is a hazard"
    UNSEEN = 19, "its ground is not observed any more"
    KEEP_OUT = 20, "a keep-out touches its zone"
    OUTSIDE_AREA = 21, "its zone is not within the landing area"
    WITHHELD = 22, ""
    OUTSIDE_MAP = 23, "its grid point is outside the map"
    UNCONFIRMED = 24, "safe ground waits for the confirmation by another assessment"
    UNMAPPED = 25, "its ground is observed, but not estimated"
    SETTLING = 26, ""
    UNLIKELY = 27, ""

    @property
    def key(self) -> str:
        """Return the name in files and diagnostics."""
        return self.name.lower()


class State(IntEnum):
    """State of the target."""

    NONE = 0  # there is none
    SETTLING = 1  # there is none until enough ground is observed
    HOLDS = 2  # a better grid point replaces it
    COMMITTED = 3  # the vehicle is below lss.commit_height: only a hazard or a request changes it
    NOW = 4  # the best within reach, after a request to land now


Request = Enum("Request", "NONE RELEASE LAND_NOW")


class Motion(NamedTuple):
    """Motion of the vehicle, map frame, m and m/s; position x and y NaN if unknown."""

    z: float
    down: float
    x: float = nan
    y: float = nan
    along_x: float = 0.0
    along_y: float = 0.0


@dataclass(frozen=True)
class Descent:
    """Remaining descent: height over the ground, m, and downward speed, m/s."""

    height: float
    speed: float

    @property
    def seconds(self) -> float:
        """Return the time left, s."""
        return self.height / max(self.speed, MIN_DESCENT_SPEED)

    @property
    def reach(self) -> float:
        """Return how far the vehicle can divert, m: it accelerates for half of the time left,
        brakes for the other half, and flies at least 45 degrees down."""
        return max(min(self.height, 0.25 * LATERAL_ACCELERATION * self.seconds**2), 0.0)


@dataclass(frozen=True)
class Choice:
    """The target: row and column of its grid point, and its number; None and 0 without a target.
    ``best``: without a target, the permitted grid point that ranks first, None without one."""

    point: GridIndex | None
    id: int
    reason: Reason
    state: State = State.NONE
    best: GridIndex | None = None


def same_site_distance(lss: LssConfig) -> float:
    """Return the distance up to which two positions are the same site, m."""
    # Less than half of the least distance between ranked sites.
    return 0.49 * min(lss.vehicle.diameter, lss.vehicle.lengths.min_separation)


class SiteNumbers:
    """Unique numbers of sites, from 1. A site keeps its number while the grid point where it was
    first ranked, or where it became the target, is safe."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[float, float]] = {}
        self._last = 0

    def forget(self, ground: Candidates) -> None:
        """Drop the sites that are no longer safe."""
        found = {k: ground.find(*position) for k, position in self._known.items()}
        gone = [k for k, point in found.items() if point is None or not ground.safe[point]]
        for number in (*gone, *list(self._known)[:-MAX_SITES]):
            self._known.pop(number, None)

    def number(self, x: float, y: float, lss: LssConfig) -> int:
        """Return the number of one site, a new one if none is known within `same_site_distance`."""
        nearest = min(self._known, key=lambda k: dist(self._known[k], (x, y)), default=0)
        if not nearest or dist(self._known[nearest], (x, y)) > same_site_distance(lss):
            self._last = nearest = self._last + 1
            self._known[nearest] = (x, y)
        return nearest

    def pin(self, number: int, x: float, y: float) -> None:
        """Move a site to a position."""
        self._known.pop(number, None)
        self._known[number] = (x, y)


@dataclass(frozen=True)
class Situation:
    """Inputs of the transition function, besides state and request."""

    ground: Candidates
    lss: LssConfig
    reason_at: Callable[[int, int], Reason]  # why landing is not permitted at a row and column
    no_site_reason: Reason  # why it is not permitted anywhere
    descent: Descent | None = None  # to the target, None if unknown
    settled: bool = True  # enough ground is observed, or ``lss.settle_time`` is over
    now: Candidates | None = None  # candidates within reach
    before: Candidates | None = None  # of the assessment before

    @cached_property
    def confirmed(self) -> Mask:
        """Return (ny, nx) candidates that are probable enough and were safe before, too: ground at
        the edge of the observed part often changes with later scans."""
        if self.before is None:
            return np.zeros_like(self.ground.safe)
        return self.ground.probable(self.lss.min_probability) & self.before.safe_on(self.ground)

    @property
    def is_low(self) -> bool:
        """Return whether the vehicle is below the height of commitment."""
        return self.descent is not None and self.descent.height <= self.lss.commit_height

    def transition(
        self, state: State, request: Request, held: tuple[float, float] | None
    ) -> tuple[State, GridIndex | None, Reason]:
        """Return the next state, row and column of the target, and the reason; ``state``,
        ``held``: state and target (x, y), m, of the assessment before.

        A lost target is withdrawn, and the next assessment chooses another one; in state NOW the
        same assessment does.
        """
        if (state is State.NOW or request is Request.LAND_NOW) and request is not Request.RELEASE:
            return State.NOW, *self._land_now(None if request is Request.LAND_NOW else held)
        if held is None or request is Request.RELEASE:
            point, reason = self._choose(request, held)
        else:
            point, reason = self._keep(held)
        if point is None:
            return State.SETTLING if reason is Reason.SETTLING else State.NONE, None, reason
        return State.COMMITTED if self.is_low else State.HOLDS, point, reason

    def _choose(
        self, request: Request, held: tuple[float, float] | None
    ) -> tuple[GridIndex | None, Reason]:
        """Choose a target as if there were none."""
        released = request is Request.RELEASE
        if not self.ground.permitted.any():
            return None, self.no_site_reason
        if not (self.settled or self.is_low or released):
            return None, Reason.SETTLING
        if not self.ground.probable(self.lss.min_probability).any():
            return None, Reason.UNLIKELY
        point = self.ground.rank_first(np.where(self.confirmed, self.ground.cost, inf))
        if point is None:
            return None, Reason.UNCONFIRMED
        return point, Reason.FIRST if held is None else Reason.RELEASED

    def _keep(self, held: tuple[float, float]) -> tuple[GridIndex | None, Reason]:
        """Keep the target, change it for a better one, or withdraw it."""
        point = self.ground.find(*held)
        if point is None:
            return None, Reason.OUTSIDE_MAP
        reason = self._reason_to_withdraw(point)
        if reason not in (None, Reason.UNLIKELY):
            return None, reason
        if not self.is_low:
            descent, commit = self.descent, self.lss.commit_height
            left = None if descent is None else Descent(descent.height - commit, descent.speed)
            if better := self._better(self.ground, self.confirmed, point, left):
                return better, Reason.BETTER
        return (point, Reason.HOLDS) if reason is None else (None, reason)

    def _reason_to_withdraw(self, point: GridIndex) -> Reason | None:
        """Return why the target cannot stay, None if it can."""
        most, unsafe = 1.0 - self.lss.min_probability, self.ground.unsafe
        if self.ground.permitted[point]:
            probable = self.is_low or unsafe is None or not unsafe[point] > most
            return None if probable else Reason.UNLIKELY
        reason = self.reason_at(*point)
        if reason is not Reason.HAZARD or unsafe is None or not unsafe[point] <= most:
            return reason
        tolerable = self.is_low or self._risk_nearby(point) <= KEEP_RISK_FACTOR * self.lss.max_risk
        return None if tolerable else reason

    def _risk_nearby(self, point: GridIndex) -> float:
        """Return the greatest risk within half of ``lss.margin`` of the target."""
        steps = round(0.5 * self.lss.margin / self.lss.spacing)
        row, column = (slice(max(i - steps, 0), i + steps + 1) for i in point)
        return float(self.ground.risk[row, column].max())

    def _land_now(self, held: tuple[float, float] | None) -> tuple[GridIndex | None, Reason]:
        """Keep the target at any risk while it is observed and the restrictions permit it, unless
        another one within reach is better; else choose the best within reach."""
        now, point = self.now, None if held is None else self.ground.find(*held)
        excluded = point is None or np.isnan(self.ground.cost[point])
        if point is None or (excluded and self.reason_at(*point) is not Reason.HAZARD):
            best = None if now is None else now.best
            return best, self.no_site_reason if best is None else Reason.LAND_NOW
        risk = 0.0 if self.ground.unsafe is None else float(self.ground.unsafe[point])
        if now is not None and not (self.is_low and risk <= 1.0 - self.lss.min_probability):
            if better := self._better(now, now.permitted, point, self.descent):
                return better, Reason.BETTER
        return point, Reason.HOLDS

    def _better(
        self, ground: Candidates, allowed: Mask, held: GridIndex, left: Descent | None
    ) -> GridIndex | None:
        """Return the grid point that ranks first after the cost of the divert, if the expected
        gain exceeds that cost. ``left``: the descent that is left for the divert."""
        share, least = GAIN_AND_COST[self.lss.ranking]
        cost = ground.cost[held]
        if ground.unsafe is not None and np.isnan(cost):  # excluded, but kept
            cost = ground.unsafe[held]
        worth = allowed & (share * (cost - ground.cost) > least)
        if not worth.any():
            return None
        row, column = np.nonzero(worth)
        price = np.full(len(row), least / share)
        if left is not None:
            away = np.hypot(ground.x[column] - ground.x[held[1]], ground.y[row] - ground.y[held[0]])
            part = away / max(left.reach, 1e-9)
            price = np.where(part < 1.0, price / np.maximum(1.0 - part, 1e-9), inf)
        net = np.full(ground.cost.shape, inf)
        net[row, column] = ground.cost[row, column] + price
        point = ground.rank_first(net)
        return point if point is not None and net[point] < cost else None


class TargetKeeper:
    """Keeps the target from one assessment to the next.

    ``held``: x and y, m, None without a target. ``assessments``: number of assessments.
    """

    def __init__(self) -> None:
        self.assessments = 0
        self.site_numbers = SiteNumbers()
        self.held: tuple[float, float] | None = None
        self._state, self._request = State.NONE, Request.NONE
        self._id = 0
        self._before: Candidates | None = None
        self._preferred: object = None

    def release(self) -> None:
        """Request another choice, as if there were no target; ends `land_now`."""
        self._request = Request.RELEASE

    def land_now(self) -> None:
        """Request the best grid point within reach, until `release`."""
        self._request = Request.LAND_NOW

    def apply_restrictions(self, restrictions: Restrictions, lss: LssConfig) -> None:
        """Request another choice if the area excludes the target, or another point is preferred.

        Guidance sends its area and preferred point repeatedly, so an area that contains the
        target's zone, and a preferred point at the target, request nothing.
        """
        goal = restrictions.target
        preferred = None if goal is None else np.asarray(goal, dtype=np.float64)[:2].tolist()
        changed, self._preferred = preferred != self._preferred, preferred
        if self.held is None or State.NOW is self._state or self._request is Request.LAND_NOW:
            return
        if preferred is not None and dist(preferred, self.held) <= same_site_distance(lss):
            changed = False
        if changed or restrictions.reason_against(*self.held, lss) is Reason.OUTSIDE_AREA:
            self.release()

    def choose(self, situation: Situation) -> Choice:
        """Return the target after one more assessment."""
        self.assessments += 1
        ground = situation.ground
        self.site_numbers.forget(ground)
        situation, self._before = replace(situation, before=self._before), ground
        self._state, point, reason = situation.transition(self._state, self._request, self.held)
        self._request, self.held = Request.NONE, None
        if point is None:
            return Choice(None, 0, reason, self._state, ground.best)
        self.held = float(ground.x[point[1]]), float(ground.y[point[0]])
        if reason is not Reason.HOLDS:
            self._id = self.site_numbers.number(*self.held, situation.lss)
        self.site_numbers.pin(self._id, *self.held)
        return Choice(point, self._id, reason, self._state)
