# SPDX-License-Identifier: Apache-2.0
"""Where landing is wanted, the one target that holds, and numbers for places.

The target is a grid point. It stays while landing there is permitted, whatever else the map offers,
until a grid point that is better by a margin is permitted, or somebody asks for another.
Ground that was just seen for the first time often looks different after the next scans: it becomes
the target only if the assessment before found it safe, too. A place keeps its number as long as its
ground is safe.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from math import dist

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array, Mask, Numbers
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.geometry.polygons import signed_distance

#: Places that are remembered; of more the oldest are forgotten.
MAX_PLACES = 1000


class Reason(IntEnum):
    """Why the target is what it is: below 16 there is one, from 16 on there is none."""

    HOLDS = 0
    FIRST = 1
    BETTER = 2
    RELEASED = 3
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

    @property
    def key(self) -> str:
        """In files and diagnostics."""
        return self.name.lower()


@dataclass(frozen=True)
class Restrictions:
    """Where landing is wanted and where not, map frame, m; None for no such restriction.

    Attributes:
        area: (V, 2) polygon that the landing zone must lie in.
        keep_out: (V, 2) polygon that the zone must not touch.
        target: (2,) or (3,) place to be near to.
        withheld: Why no site may be given out, however safe the ground, such as a keep-out that
            cannot be read; empty if nothing speaks against it.

    A polygon that crosses itself is inside where a ray to it crosses it an odd number of times.
    With one of fewer than three or not finite vertices, or a target that is not finite, nobody
    knows where landing is wanted: no site is given out and the explanation says why.
    """

    area: ArrayLike | None = None
    keep_out: ArrayLike | None = None
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
        """Does as `apply` says.

        Raises:
            ValueError, TypeError: a polygon with fewer than three finite vertices, a target that is
                not finite, or not numbers.
        """
        if self.area is None and self.keep_out is None and self.target is None:
            return
        # Only what is left is looked at: areas come with every second of a flight.
        row, column = np.nonzero(np.isfinite(cost))
        left, zone = cost[row, column], 0.5 * lss.vehicle_diameter + lss.margin
        if self.area is not None:
            left[signed_distance(self.area, x[column], y[row]) < zone] = np.nan
        if self.keep_out is not None:
            left[signed_distance(self.keep_out, x[column], y[row]) > -zone] = np.nan
        if self.target is not None:
            goal = np.asarray(self.target, dtype=np.float64)
            if goal.shape not in ((2,), (3,)) or not np.isfinite(goal[:2]).all():
                msg = f"a landing target needs two or three finite coordinates, got {self.target!r}"
                raise ValueError(msg)
            by_score = lss.ranking == "score"
            weight = lss.weight_target if by_score else lss.target_risk
            left += weight * np.hypot(x[column] - goal[0], y[row] - goal[1])
        cost[row, column] = left

    def wish(self) -> tuple[list[object] | None, ...]:
        """Area and target: another one asks for another choice."""
        return tuple(
            None if given is None else np.ravel(np.asarray(given, dtype=object)).tolist()
            for given in (self.area, self.target)
        )

    def area_holds(self, x: float, y: float, lss: LssConfig) -> bool:
        """Whether the area, if there is one, holds the zone about a place."""
        if self.area is None:
            return True
        try:
            inside = signed_distance(self.area, np.array([x]), np.array([y]))[0]
        except (TypeError, ValueError):
            return False
        return bool(inside >= 0.5 * lss.vehicle_diameter + lss.margin)

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
    """

    x: Array
    y: Array
    safe: Mask
    cost: Array

    def at(self, x: float, y: float) -> tuple[int, int] | None:
        """Row and column of the grid point at a place, None if there is none."""
        return grid_point(self.x, self.y, x, y)

    def same_grid(self, other: Candidates) -> bool:
        """Whether the grid points are the same."""
        return np.array_equal(self.x, other.x) and np.array_equal(self.y, other.y)


@dataclass(frozen=True)
class Choice:
    """Where the target is.

    Attributes:
        place: Row and column of its grid point, None if there is no target.
        id: Number of its place, 0 if there is none.
        reason: Why it is this one, or why there is none.
    """

    place: tuple[int, int] | None
    id: int
    reason: Reason


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
        self._released = False
        self._before: Candidates | None = None
        self._wish: tuple[object, ...] | None = None

    def release(self) -> None:
        """Give the target up: the next one is chosen as if none had been held."""
        self._released = True

    def heed(self, wanted: Restrictions, reach: float, lss: LssConfig) -> None:
        """Give it up for another landing area without it, or another place to be near to.

        Guidance says what it can still reach, and where it is going, again and again: an area that
        holds the target, and a place within ``reach`` (m) of it, ask for no other.
        """
        wish, before = wanted.wish(), self._wish
        self._wish = wish
        if before is None or wish == before:
            return
        kept = self._held is not None
        if self._held is not None and wish[0] != before[0]:
            kept = wanted.area_holds(*self._held, lss)
        if self._held is not None and wish[1] != before[1]:
            kept &= wanted.is_near(*self._held, reach)
        if not kept:
            self.release()

    def choose(
        self,
        ground: Candidates,
        *,
        margin: float,
        reach: float,
        why_not: Callable[[int, int], Reason],
        why_none: Reason,
    ) -> Choice:
        """The target after one more assessment.

        One that is lost is followed by none, and only in the next assessment by another: whoever
        flies to it hears of it in any case.

        Args:
            ground: What was assessed.
            margin: By how much another must be better, in the unit of ``cost``.
            reach: Places no farther from each other are the same one, m.
            why_not: Why landing is not permitted at a row and column.
            why_none: Reason to be given if landing is permitted nowhere.
        """
        self.places.forget(ground)
        permitted = np.isfinite(ground.cost)
        best = self._best(ground, permitted)
        held, released = self._held, self._released
        self._held, self._released = None, False
        reason = Reason.FIRST if held is None else Reason.RELEASED
        if not permitted.any():
            lost = None if held is None or released else ground.at(*held)
            return Choice(None, 0, why_none if lost is None else why_not(*lost))
        if held is not None and not released:
            place = ground.at(*held)
            if place is None:
                return Choice(None, 0, Reason.OUTSIDE_MAP)
            if not permitted[place]:
                return Choice(None, 0, why_not(*place))
            reason = Reason.BETTER
            if best is None or ground.cost[place] - ground.cost[best] <= margin:
                best, reason = place, Reason.HOLDS
        if best is None:
            return Choice(None, 0, Reason.UNCONFIRMED)
        self._held = float(ground.x[best[1]]), float(ground.y[best[0]])
        if reason != Reason.HOLDS:
            self._id = self.places.number(*self._held, reach)
        self.places.pin(self._id, *self._held)
        return Choice(best, self._id, reason)

    def _best(self, ground: Candidates, permitted: Mask) -> tuple[int, int] | None:
        """The best grid point of those that were safe in the last assessment, too."""
        before, self._before = self._before, ground
        if before is None or not ground.same_grid(before):
            return None
        again = np.flatnonzero(before.safe & permitted)
        if not len(again):
            return None
        return divmod(int(again[np.argmin(ground.cost.take(again))]), len(ground.x))


def grid_point(x: Array, y: Array, place_x: float, place_y: float) -> tuple[int, int] | None:
    """Row and column of the grid point at a place, None if there is none."""
    row, column = bisect_left(y, place_y), bisect_left(x, place_x)
    found = row < len(y) and column < len(x) and y[row] == place_y and x[column] == place_x
    return (row, column) if found else None
