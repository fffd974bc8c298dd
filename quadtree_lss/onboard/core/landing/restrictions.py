# SPDX-License-Identifier: Apache-2.0
"""Restrictions of the landing site: area, keep-outs and a preferred point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.geometry.polygons import signed_distance
from quadtree_lss.onboard.core.landing.target import DISTANCE_COST, Reason


@dataclass(frozen=True)
class Restrictions:
    """Restrictions of landing, map frame, m; None for no such restriction.

    A polygon that crosses itself follows the even-odd rule.

    Attributes:
        area: (V, 2) polygon that contains the landing zone.
        keep_outs: (V, 2) polygons that the zone does not touch.
        target: (2,) or (3,) preferred point.
        why_withheld: Why no site may be published, such as an unreadable keep-out; empty if none.
    """

    area: ArrayLike | None = None
    keep_outs: Sequence[ArrayLike] = ()
    target: ArrayLike | None = None
    why_withheld: str = ""

    def checked(self) -> Restrictions:
        """Return these restrictions; if a polygon has fewer than three vertices, or a polygon or
        the target is not finite, return that no site may be published."""
        nowhere = np.zeros(0)
        try:
            for polygon in (*([] if self.area is None else [self.area]), *self.keep_outs):
                signed_distance(polygon, nowhere, nowhere)
            if self.target is not None:
                goal = np.asarray(self.target, dtype=np.float64)
                if goal.shape not in ((2,), (3,)) or not np.isfinite(goal[:2]).all():
                    msg = "a landing target needs two or three finite coordinates"
                    raise ValueError(f"{msg}, got {self.target!r}")
        except (TypeError, ValueError) as error:
            return Restrictions(why_withheld=self.why_withheld or str(error))
        return self

    def apply_to(self, cost: Array, x: Array, y: Array, lss: LssConfig) -> None:
        """Set the cost (ny, nx) of excluded grid points to NaN, and add the cost of the distance to
        the preferred point."""
        if self.why_withheld:
            cost[...] = np.nan
        if self.area is None and not self.keep_outs and self.target is None:
            return
        row, column = np.nonzero(np.isfinite(cost))
        left = cost[row, column]
        if self.area is not None:
            left[signed_distance(self.area, x[column], y[row]) < lss.zone] = np.nan
        for polygon in self.keep_outs:
            left[signed_distance(polygon, x[column], y[row]) > -lss.zone] = np.nan
        if self.target is not None:
            goal = np.asarray(self.target, dtype=np.float64)
            left += DISTANCE_COST[lss.ranking] * np.hypot(x[column] - goal[0], y[row] - goal[1])
        cost[row, column] = left

    def outside_domain(self, x: Array, y: Array) -> str:
        """Return a message if the landing area lies outside the grid, else an empty string."""
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

    def observed_share(self, observed: Mask, x: Array, y: Array) -> float:
        """Return the observed share of the grid points (ny, nx) in the area, or of all."""
        if self.area is not None:
            step = max(len(x) // 64, 1)  # 64 x 64 points give the share to 1 %
            observed, (xs, ys) = observed[::step, ::step], np.meshgrid(x[::step], y[::step])
            observed = observed[signed_distance(self.area, xs, ys) >= 0.0]
        return float(np.count_nonzero(observed) / observed.size) if observed.size else 0.0

    def reason_against(self, x: float, y: float, lss: LssConfig) -> Reason | None:
        """Return why the restrictions exclude a point, None if they do not."""
        point = np.array([x]), np.array([y])
        if self.area is not None and signed_distance(self.area, *point)[0] < lss.zone:
            return Reason.OUTSIDE_AREA
        touched = any(signed_distance(polygon, *point)[0] > -lss.zone for polygon in self.keep_outs)
        return Reason.KEEP_OUT if touched else None
