# SPDX-License-Identifier: Apache-2.0
"""The one target that holds, and numbers for places that last as long as the ground does.

The target is a grid point. It stays while landing there is permitted, whatever else the map offers,
until a grid point that is better by a margin is permitted, or somebody asks for another.
Ground that was just seen for the first time often looks different after the next scans: it becomes
the target only if the assessment before found it safe, too.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from math import dist

import numpy as np

from quadtree_lss.onboard.arrays import Array, Mask, Numbers

MAX_PLACES = 1000
"""Places that are remembered; of more the oldest are forgotten."""


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


WhyNot = Callable[[int, int], Reason]


@dataclass(frozen=True)
class Ground:
    """An assessed map on its grid.

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

    def same_grid(self, other: Ground) -> bool:
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

    def forget(self, ground: Ground) -> None:
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
        self._before: Ground | None = None

    @property
    def held(self) -> tuple[float, float] | None:
        """x and y of the target, None if there is none."""
        return self._held

    def release(self) -> None:
        """Give the target up: the next one is chosen as if none had been held."""
        self._released = True

    def choose(
        self, ground: Ground, *, margin: float, reach: float, why_not: WhyNot, why_none: Reason
    ) -> Choice:
        """The target after one more assessment.

        One that is lost is followed by none, and only in the next assessment by another: whoever
        flies to it is told in any case.

        Args:
            ground: What was assessed.
            margin: By how much another must be better, in the unit of ``cost``.
            reach: Places no farther from each other are the same one, m.
            why_not: Tells of a row and column why landing is not permitted there.
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

    def _best(self, ground: Ground, permitted: Mask) -> tuple[int, int] | None:
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
