# SPDX-License-Identifier: Apache-2.0
"""Scans that contradict the map: refused, until many in a row agree with each other."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.mapping.departure import FLOOR, MIN_CELLS, Departure
from quadtree_lss.onboard.core.mapping.update import OF_SCAN, OWN, RISE

#: A scan contradicts the map if less than this share of its cells stands where they may, ...
SHARE = 1.0 / 3.0
#: ... or if these depart in common by more than so many deviations: of three degrees of freedom one
#: sound scan in 7,000 does.
DEVIATIONS = 4.5
#: Share of a scan's points in estimated leaves that must lie in comparable ones before it can
#: contradict the map: sound scans over simulated cliffs with up to 0.22 were rejected.
SMOOTH = 0.25
#: A view narrower than the leaves touches so many of them at the most.
NARROW = 4
#: So many scans in a row that agree with each other are right and the map is wrong.
AGREEING = 10


class Verdict(Enum):
    """What is to become of a scan."""

    SOUND = 0
    REFUSED = 1
    #: The map was wrong: it is to be lifted to the scan, or forgotten where that does not help.
    OVERRULES = 2


@dataclass
class Contradiction:
    """The scans refused in a row. ``count``: how many. ``height``, ``variance``: of the last one's
    ground over the map's, m, and how well its pose knows that, m^2."""

    count: int = 0
    height: float = 0.0
    variance: float = 0.0

    def judge(self, cells: Array, contradicts: bool) -> Verdict:
        """Judge a scan by how its ground stands over the map's.

        Rocks, shadows and edges are in few cells, and wrong ground in the map is in some: only
        where a height or an attitude is beyond what is claimed do most cells, or all in common,
        depart. `AGREEING` refused scans whose heights are the same but for what their own poses
        claim win. ``cells``: of `ScanUpdate.fit` or `ScanUpdate.parts`.
        """
        if not contradicts:
            self.count = 0
            return Verdict.SOUND
        height = float(np.median(cells[RISE]))
        variance = float(np.median(cells[OWN] + cells[OF_SCAN]))
        allowed = DEVIATIONS**2 * (variance + self.variance)
        agrees = self.count > 0 and (height - self.height) ** 2 <= allowed
        self.count = self.count + 1 if agrees else 1
        self.height, self.variance = height, variance
        if self.count < AGREEING:
            return Verdict.REFUSED
        self.count = 0
        return Verdict.OVERRULES


def departs(found: Departure | None) -> bool:
    """Whether a scan contradicts the map."""
    return found is not None and (found.share < SHARE or found.deviations > DEVIATIONS)


def stands_apart(parts: Array, metre: float) -> bool:
    """Whether a scan of a view so narrow that its leaves hardly tell a `Departure` contradicts the
    map: whether less than `SHARE` of the finest cells that were known stand where they may.
    ``parts``: (4, M) of `ScanUpdate.parts`. ``metre``: as of `departure.departure`."""
    height, own, of_scan, of_map = parts
    allowed = DEVIATIONS**2 * (own + of_scan + of_map + FLOOR * metre**2)
    count = len(height)
    stand = int(np.count_nonzero(height**2 <= allowed))
    return count >= MIN_CELLS and stand < SHARE * count
