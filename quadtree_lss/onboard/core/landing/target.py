# SPDX-License-Identifier: Apache-2.0
"""Where landing is wanted, the one target that holds, and numbers for places.

The target is a grid point. There is none until enough is seen to choose from. Then it stays while
landing there is permitted, whatever else the map offers, until another grid point is better by more
than the gain is uncertain by and the way there costs, or somebody asks for another. With c the cost
of a grid point, p the probability of a safe touchdown if the lander aims there, it gives way if

    c(target) - c > M / (1 - d / r) + 0.5 hypot(1 - p(target), 1 - p),    d < r,

where M is `SWITCH`, d the distance between the two and r how far aside the vehicle
still gets (`Descent`). Below ``lss.commit_height`` nothing better moves it.
Ground that was just seen for the first time often looks different after the next scans: it becomes
the target only if the assessment before found it safe, too. A place keeps its number as long as its
ground is safe.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from math import dist, inf, nan
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array, Mask, Numbers
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.geometry.polygons import signed_distance
from quadtree_lss.onboard.core.landing.ranking import MODEL_ERROR, best_among_equals, lowest
from quadtree_lss.onboard.core.tree.domain import carried

#: Places that are remembered; of more the oldest are forgotten.
MAX_PLACES = 1000
#: Ground under the target, or beside it, that is found less safe than to be chosen is a hazard if
#: touchdown fails with so many times ``lss.max_risk``.
KEPT = 3.0
#: Of the area, or of the domain, that is seen before there is a target, unless the time for it is
#: up: a closed loop's look over its candidate area shows so much (``config/flight.yaml``).
SETTLE_SHARE = 0.63
#: How much better another place has to be, besides doubt and way, to replace the target: one per
#: cent more probably safe; in the score 4 m more room to the nearest hazard, or 4.6 degrees less
#: slope.
SWITCH = {"probability": 0.01, "score": 0.08}
#: Cost of a metre of distance from the wanted place: 0.1 % of probability, so that of two equal
#: sites the nearer ranks first; in the score 0.2 m of room.
NEARER = {"probability": 0.001, "score": 0.004}
#: How a vehicle gets aside on its way down: acceleration, m/s^2, and the least speed downwards that
#: its time is reckoned with, m/s.
ASIDE, SLOWEST = 1.0, 0.5
#: Places are the same to so much of the grid's spacing: one that follows is not moved to the bit.
SAME = 1e-6


class Reason(IntEnum):
    """Why the target is what it is: below 16 there is one, from 16 on there is none."""

    HOLDS = 0
    FIRST = 1
    BETTER = 2
    RELEASED = 3
    LAND_NOW = 4
    NOTHING_MAPPED = 16
    NO_SITE = 17
    HAZARD = 18
    UNSEEN = 19
    KEEP_OUT = 20
    OUTSIDE_AREA = 21
    WITHHELD = 22
    OUTSIDE_MAP = 23
    UNCONFIRMED = 24
    UNMAPPED = 25
    SETTLING = 26
    UNLIKELY = 27

    @property
    def key(self) -> str:
        """In files and diagnostics."""
        return self.name.lower()


class State(IntEnum):
    """What goes on with the target."""

    NONE = 0
    #: There is none before enough is seen.
    SETTLING = 1
    #: It may give way to a better one.
    HOLDS = 2
    #: Only a hazard takes it away, or who asks for it.
    COMMITTED = 3
    #: The best within reach, whatever its risk.
    NOW = 4


class Motion(NamedTuple):
    """Of the vehicle: its height in the map frame, m, and speed downwards, m/s; its place there, m,
    NaN if nobody knows, and speed along x and y, m/s."""

    z: float
    down: float
    x: float = nan
    y: float = nan
    along_x: float = 0.0
    along_y: float = 0.0


@dataclass(frozen=True)
class Descent:
    """What is left of the way down.

    Attributes:
        height: Of the vehicle over the ground, m.
        speed: Downwards, m/s.
    """

    height: float
    speed: float

    @property
    def seconds(self) -> float:
        """What is left of it, s."""
        return self.height / max(self.speed, SLOWEST)

    @property
    def reach(self) -> float:
        """How far aside it still comes down, m: speeding up for half of the time, slowing down for
        the other; and not farther than it is high."""
        return max(min(self.height, 0.25 * ASIDE * self.seconds**2), 0.0)


@dataclass(frozen=True)
class Restrictions:
    """Where landing is wanted and where not, map frame, m; None for no such restriction.

    Attributes:
        area: (V, 2) polygon that the landing zone must lie in.
        keep_outs: (V, 2) polygons that the zone must not touch.
        target: (2,) or (3,) place to be near to.
        withheld: Why no site may be given out, however safe the ground, such as a keep-out that
            cannot be read; empty if nothing speaks against it.

    A polygon that crosses itself is inside where a ray to it crosses it an odd number of times.
    With one of fewer than three or not finite vertices, or a target that is not finite, nobody
    knows where landing is wanted: no site is given out and the explanation says why.
    """

    area: ArrayLike | None = None
    keep_outs: Sequence[ArrayLike] = ()
    target: ArrayLike | None = None
    withheld: str = ""

    def apply(self, cost: Array, x: Array, y: Array, lss: LssConfig) -> str:
        """Exclude grid points (ny, nx), and add what the way to the target costs.

        Returns:
            Why no site may be given out and all is excluded, empty if that is not so.
        """
        why = self.withheld
        try:
            self._exclude(cost, x, y, lss)
        except (TypeError, ValueError) as error:
            why = why or str(error)
        if why:
            cost[...] = np.nan
        return why

    def _exclude(self, cost: Array, x: Array, y: Array, lss: LssConfig) -> None:
        """Does as `apply` says. Raises `ValueError` or `TypeError`: a polygon or target is none."""
        if self.area is None and not self.keep_outs and self.target is None:
            return
        # Only what is left is looked at: areas come with every second of a flight.
        row, column = np.nonzero(np.isfinite(cost))
        left = cost[row, column]
        if self.area is not None:
            left[signed_distance(self.area, x[column], y[row]) < lss.zone] = np.nan
        for polygon in self.keep_outs:
            left[signed_distance(polygon, x[column], y[row]) > -lss.zone] = np.nan
        if self.target is not None:
            goal = np.asarray(self.target, dtype=np.float64)
            if goal.shape not in ((2,), (3,)) or not np.isfinite(goal[:2]).all():
                msg = f"a landing target needs two or three finite coordinates, got {self.target!r}"
                raise ValueError(msg)
            left += NEARER[lss.ranking] * np.hypot(x[column] - goal[0], y[row] - goal[1])
        cost[row, column] = left

    def beside(self, x: Array, y: Array) -> str:
        """That the area lies outside of the grid; empty if it does not."""
        if self.area is None:
            return ""
        area = np.array([np.min(self.area, axis=0), np.max(self.area, axis=0)]).T[:2]
        grid = np.array([x[[0, -1]], y[[0, -1]]])
        if (area[:, 0] <= grid[:, 1]).all() and (area[:, 1] >= grid[:, 0]).all():
            return ""
        texts = (
            ", ".join(f"{n} {a:g} ... {b:g}" for n, (a, b) in zip("xy", box, strict=True))
            for box in (area, grid)
        )
        return "the landing area, {}, lies outside the domain, {} m".format(*texts)

    def wish(self) -> tuple[list[object] | None, ...]:
        """Area and target: another one asks for another choice."""
        return tuple(
            None if given is None else np.ravel(np.asarray(given, dtype=object)).tolist()
            for given in (self.area, self.target)
        )

    def share(self, seen: Mask, x: Array, y: Array) -> float:
        """Of the grid points (ny, nx) in the area, if there is one, those that are seen."""
        if self.area is not None:
            step = max(len(x) // 64, 1)  # so many say it to a hundredth
            seen, (xs, ys) = seen[::step, ::step], np.meshgrid(x[::step], y[::step])
            try:
                seen = seen[signed_distance(self.area, xs, ys) >= 0.0]
            except (TypeError, ValueError):
                return 0.0
        return float(np.count_nonzero(seen) / seen.size) if seen.size else 0.0

    def fault(self, x: float, y: float, lss: LssConfig) -> Reason | None:
        """Why landing is not wanted at a place, None if nothing speaks against it."""
        if not self.area_holds(x, y, lss):
            return Reason.OUTSIDE_AREA
        at = np.array([x]), np.array([y])
        touched = any(signed_distance(polygon, *at)[0] > -lss.zone for polygon in self.keep_outs)
        return Reason.KEEP_OUT if touched else None

    def area_holds(self, x: float, y: float, lss: LssConfig) -> bool:
        """Whether the area, if there is one, holds the zone about a place."""
        if self.area is None:
            return True
        try:
            inside = signed_distance(self.area, np.array([x]), np.array([y]))[0]
        except (TypeError, ValueError):
            return False
        return bool(inside >= lss.zone)

    def is_near(self, x: float, y: float, reach: float) -> bool:
        """Whether the place to be near to is this one."""
        try:
            goal = np.asarray(self.target, dtype=np.float64)
            return bool(np.hypot(goal[0] - x, goal[1] - y) <= reach)
        except (TypeError, ValueError, IndexError):
            return False


@dataclass(frozen=True)
class Candidates:
    """Where an assessed map permits landing, on its grid.

    Attributes:
        x, y: (nx,), (ny,) of the grid points, m.
        safe: (ny, nx) landing is allowed by the ground.
        cost: (ny, nx) how bad it is, less is better; NaN where it is not permitted, be it for the
            ground or for where landing is wanted.
        unsafe: (ny, nx) probability that touchdown fails if the lander aims there; NaN or None if
            nobody asked for it.
        clearance: (ny, nx) how far the landing zone may move until it touches excluded ground, m;
            None if unknown.
    """

    x: Array
    y: Array
    safe: Mask
    cost: Array
    unsafe: Array | None = None
    clearance: Array | None = None

    @cached_property
    def permitted(self) -> Mask:
        """(ny, nx) where landing is permitted."""
        return np.isfinite(self.cost)

    @cached_property
    def best(self) -> tuple[int, int] | None:
        """Row and column of the permitted grid point with the lowest cost, None without one."""
        return lowest(np.fmin(self.cost, inf)) if self.permitted.any() else None

    def at(self, x: float, y: float) -> tuple[int, int] | None:
        """Row and column of the grid point at a place, but for rounding; None if there is none."""
        slack = SAME * float(self.x[1] - self.x[0]) if len(self.x) > 1 else 0.0
        row, column = bisect_left(self.y, y - slack), bisect_left(self.x, x - slack)
        found = row < len(self.y) and column < len(self.x)
        found = found and self.y[row] <= y + slack and self.x[column] <= x + slack
        return (row, column) if found else None

    def safe_on(self, other: Candidates) -> Mask:
        """`safe` at the grid points of another, whose grid may be this one moved by whole steps;
        False where there was none."""
        if np.array_equal(self.x, other.x) and np.array_equal(self.y, other.y):
            return self.safe
        nowhere = np.zeros_like(other.safe)
        if self.safe.shape != other.safe.shape or min(nowhere.shape) < 2:
            return nowhere
        axes, steps = ((self.x, other.x), (self.y, other.y)), []
        for of, to in axes:
            steps.append(round((to[0] - of[0]) / (of[1] - of[0])))
            if np.abs(to[0] - of[0] - steps[-1] * (of[1] - of[0])) > SAME * (of[1] - of[0]):
                return nowhere
        return carried(self.safe, steps[0], steps[1], False)


@dataclass(frozen=True)
class Choice:
    """Where the target is.

    Attributes:
        place: Row and column of its grid point, None if there is no target.
        id: Number of its place, 0 if there is none.
        reason: Why it is this one, or why there is none.
        state: What is going on.
        best: Without a target, row and column of the best that is permitted, None if nothing is.
    """

    place: tuple[int, int] | None
    id: int
    reason: Reason
    state: State = State.NONE
    best: tuple[int, int] | None = None


class Places:
    """Numbers places, from 1; a number is never given twice.

    A place keeps its number while the grid point where it was first met, or where it became the
    target, is safe; what lies within ``reach`` of that grid point has the same number.
    """

    def __init__(self) -> None:
        self._known: dict[int, tuple[float, float]] = {}
        self._last = 0

    def forget(self, ground: Candidates) -> None:
        """Forget the places that are not safe any more."""
        found = {k: ground.at(*place) for k, place in self._known.items()}
        gone = [k for k, place in found.items() if place is None or not ground.safe[place]]
        for number in (*gone, *list(self._known)[:-MAX_PLACES]):
            self._known.pop(number, None)

    def numbers(self, places: Array, reach: float) -> Numbers:
        """Numbers (K,) of places (K, 2), in m: new ones where none is known within ``reach``."""
        return np.array([self.number(x, y, reach) for x, y in places.tolist()], dtype=np.uint32)

    def number(self, x: float, y: float, reach: float) -> int:
        """Number of one place."""
        nearest = min(self._known, key=lambda k: dist(self._known[k], (x, y)), default=0)
        if not nearest or dist(self._known[nearest], (x, y)) > reach:
            self._last = nearest = self._last + 1
            self._known[nearest] = (x, y)
        return nearest

    def pin(self, number: int, x: float, y: float) -> None:
        """From now on this number is that of what is about here."""
        self._known.pop(number, None)
        self._known[number] = (x, y)


class TargetKeeper:
    """Holds the target from one assessment to the next.

    Attributes:
        places: Numbers of the places that were target or ranked.
    """

    def __init__(self) -> None:
        self.places = Places()
        self._held: tuple[float, float] | None = None
        self._id = 0
        self._released = self._now = False
        self._before: Candidates | None = None
        self._wish: tuple[object, ...] | None = None

    def release(self) -> None:
        """Give the target up: the next one is chosen as if none had been held."""
        self._released, self._now = True, False

    def land_now(self) -> None:
        """From the next assessment to `release`: the best within reach, without waiting."""
        self._held, self._now = None, True

    def heed(self, wanted: Restrictions, reach: float, lss: LssConfig) -> None:
        """Give it up for another landing area without it, or another place to be near to.

        Guidance says what it can still reach, and where it is going, again and again: an area that
        holds the target, and a place within ``reach`` (m) of it, ask for no other.
        """
        wish, before = wanted.wish(), self._wish
        self._wish = wish
        if before is None or self._held is None or self._now:
            return
        kept = True
        if wish[0] != before[0]:
            kept = wanted.area_holds(*self._held, lss)
        if wish[1] != before[1]:
            kept &= wanted.is_near(*self._held, reach)
        if not kept:
            self.release()

    @property
    def held(self) -> tuple[float, float] | None:
        """x and y of the target, m."""
        return self._held

    def choose(
        self,
        ground: Candidates,
        lss: LssConfig,
        *,
        reach: float,
        why_not: Callable[[int, int], Reason],
        why_none: Reason,
        descent: Descent | None = None,
        settled: bool = True,
        now: Candidates | None = None,
    ) -> Choice:
        """The target after one more assessment.

        After `land_now` it is the best within reach, until another is better by the same rule. Else
        one that is lost is followed by none, and only in the next assessment by another: whoever
        flies to it hears of it in any case.

        Args:
            ground: What was assessed.
            lss: Margin, height of commitment and least probability.
            reach: Places no farther from each other are the same one, m.
            why_not: Why landing is not permitted at a row and column.
            why_none: Reason to be given if landing is permitted nowhere.
            descent: Of the vehicle, None if nobody knows.
            settled: Enough is seen to choose from, or the time for it is up.
            now: The candidates within reach.
        """
        self.places.forget(ground)
        permitted = likely = ground.permitted
        least = lss.min_probability
        if ground.unsafe is not None:
            likely = permitted & ~(ground.unsafe > 1.0 - least)
        before, self._before = self._before, ground
        seen_again = likely & before.safe_on(ground) if before else np.zeros_like(likely)
        held, released = self._held, self._released
        self._held, self._released = None, False
        committed = descent is not None and descent.height <= lss.commit_height

        def none(reason: Reason, state: State = State.NONE) -> Choice:
            return Choice(None, 0, reason, state, ground.best)

        if self._now:
            place, reason = self._at_once(ground, held, lss, why_not, descent, committed, now)
            return self._keep(ground, place, reason, reach, State.NOW, why_none)
        reason = Reason.FIRST if held is None else Reason.RELEASED
        if held is not None and not released:
            place, reason = ground.at(*held), Reason.HOLDS
            if place is None:
                return none(Reason.OUTSIDE_MAP)
            if not permitted[place]:
                why = why_not(*place)
                most = 1.0 - least if committed else min(KEPT * lss.max_risk, 1.0 - least)
                bears = ground.unsafe is not None and ground.unsafe[place] <= most
                if not (bears and why == Reason.HAZARD):
                    return none(why)
            elif not (likely[place] or committed):
                return none(Reason.UNLIKELY)
            better = None if committed else self._better(ground, seen_again, place, descent, lss)
            if better is not None:
                place, reason = better, Reason.BETTER
        elif not permitted.any():
            return none(why_none)
        elif not (settled or committed or released):
            return none(Reason.SETTLING, State.SETTLING)
        elif not likely.any():
            return none(Reason.UNLIKELY)
        elif not seen_again.any():
            return none(Reason.UNCONFIRMED)
        else:
            cost = np.where(seen_again, ground.cost, nan)
            place = best_among_equals(cost, ground.unsafe, ground.clearance)
        state = State.COMMITTED if committed else State.HOLDS
        return self._keep(ground, place, reason, reach, state, why_none)

    def _keep(
        self,
        ground: Candidates,
        place: tuple[int, int] | None,
        reason: Reason,
        reach: float,
        state: State,
        why_none: Reason,
    ) -> Choice:
        """The choice of a grid point, which is held from now on."""
        if place is None:
            return Choice(None, 0, why_none)
        self._held = float(ground.x[place[1]]), float(ground.y[place[0]])
        if reason != Reason.HOLDS:
            self._id = self.places.number(*self._held, reach)
        self.places.pin(self._id, *self._held)
        return Choice(place, self._id, reason, state)

    def _at_once(
        self,
        ground: Candidates,
        held: tuple[float, float] | None,
        lss: LssConfig,
        why_not: Callable[[int, int], Reason],
        descent: Descent | None,
        committed: bool,
        now: Candidates | None,
    ) -> tuple[tuple[int, int] | None, Reason]:
        """After `land_now`: the grid point, and why. The one held stays while it is seen and
        permitted, whatever its risk; low over it, nothing moves it that is not a hazard."""
        best = None if now is None else now.best
        place = None if held is None else ground.at(*held)
        if place is None:
            return best, Reason.LAND_NOW
        if np.isnan(ground.cost[place]) and why_not(*place) != Reason.HAZARD:
            return best, Reason.LAND_NOW
        unsafe = 0.0 if ground.unsafe is None else float(ground.unsafe[place])
        if now is not None and (not committed or unsafe > 1.0 - lss.min_probability):
            if better := self._better(now, now.permitted, place, descent, lss):
                return better, Reason.BETTER
        return place, Reason.HOLDS

    def _better(
        self,
        ground: Candidates,
        allowed: Mask,
        held: tuple[int, int],
        descent: Descent | None,
        lss: LssConfig,
    ) -> tuple[int, int] | None:
        """The grid point to which the target gives way; the equation is the module's."""
        cost = ground.cost[held]
        if ground.unsafe is not None and np.isnan(cost):  # it would not be chosen any more
            cost = ground.unsafe[held]
        least = SWITCH[lss.ranking]
        if ground.unsafe is not None:  # no doubt is less than that of the one held
            least += MODEL_ERROR * np.nan_to_num(ground.unsafe[held])
        lower = np.flatnonzero(allowed & (ground.cost < cost - least))
        if not len(lower):
            return None
        row, column = np.divmod(lower, len(ground.x))
        gain = cost - ground.cost[row, column]
        margin = np.full(len(row), SWITCH[lss.ranking])
        if descent is not None:
            away = np.hypot(ground.x[column] - ground.x[held[1]], ground.y[row] - ground.y[held[0]])
            part = away / max(descent.reach, 1e-9)
            margin = np.where(part < 1.0, margin / np.maximum(1.0 - part, 1e-9), inf)
        if ground.unsafe is not None:
            doubt = np.hypot(ground.unsafe[row, column], ground.unsafe[held])
            margin += MODEL_ERROR * np.nan_to_num(doubt)
        best = int(np.argmax(gain - margin))
        return (int(row[best]), int(column[best])) if gain[best] > margin[best] else None
