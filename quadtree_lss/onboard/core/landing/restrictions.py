# SPDX-License-Identifier: Apache-2.0
"""What is left of the ground where somebody says where landing is wanted and where not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.geometry.polygons import signed_distance
from quadtree_lss.onboard.core.landing.target import Reason


@dataclass(frozen=True)
class Restrictions:
    """Where landing is wanted and where not, map frame, m; None for no such restriction.

    Attributes:
        area: (V, 2) polygon that the landing zone must lie in.
        keep_out: (V, 2) polygon that the zone must not touch.
        target: (2,) or (3,) place to be near to.
        withheld: Why no site may be given out, however safe the ground; empty if nothing speaks
            against it.
    """

    area: ArrayLike | None = None
    keep_out: ArrayLike | None = None
    target: ArrayLike | None = None
    withheld: str = ""

    def apply(self, score: Array, x: Array, y: Array, lss: LssConfig) -> str:
        """Exclude grid points (ny, nx), and add what the way to the target costs.

        Returns:
            Why no site may be given out and all is excluded, empty if that is not so.
        """
        why = self.withheld
        try:
            self._exclude(score, x, y, lss)
        except (TypeError, ValueError) as error:
            why = why or str(error)
        if why:
            score[...] = np.nan
        return why

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
        return bool(inside >= _zone(lss))

    def is_near(self, x: float, y: float, reach: float) -> bool:
        """Whether the place to be near to is this one."""
        try:
            goal = np.asarray(self.target, dtype=np.float64)
            return bool(np.hypot(goal[0] - x, goal[1] - y) <= reach)
        except (TypeError, ValueError, IndexError):
            return False

    def why_not(self, x: float, y: float, lss: LssConfig) -> Reason:
        """Why a zone on safe ground is excluded."""
        place = np.array([x]), np.array([y])
        if self.area is not None and signed_distance(self.area, *place)[0] < _zone(lss):
            return Reason.OUTSIDE_AREA
        return Reason.KEEP_OUT

    def _exclude(self, score: Array, x: Array, y: Array, lss: LssConfig) -> None:
        """Does as `apply` says.

        Raises:
            ValueError, TypeError: a polygon with fewer than three finite vertices, a target that is
                not finite, or not numbers.
        """
        if self.area is None and self.keep_out is None and self.target is None:
            return
        # Only what is left is looked at: areas come with every second of a flight.
        row, column = np.nonzero(np.isfinite(score))
        grid_x, grid_y = x[column], y[row]
        if self.area is not None:
            score[row, column] = np.where(
                signed_distance(self.area, grid_x, grid_y) < _zone(lss), np.nan, score[row, column]
            )
        if self.keep_out is not None:
            score[row, column] = np.where(
                signed_distance(self.keep_out, grid_x, grid_y) > -_zone(lss),
                np.nan,
                score[row, column],
            )
        if self.target is not None:
            goal = np.asarray(self.target, dtype=np.float64)
            if goal.shape not in ((2,), (3,)) or not np.isfinite(goal[:2]).all():
                msg = f"a landing target needs two or three finite coordinates, got {self.target!r}"
                raise ValueError(msg)
            away = np.hypot(grid_x - goal[0], grid_y - goal[1])
            by_score = lss.ranking == "score"
            score[row, column] += (lss.weight_target if by_score else lss.target_risk) * away


def _zone(lss: LssConfig) -> float:
    return 0.5 * lss.vehicle_diameter + lss.margin
