# SPDX-License-Identifier: Apache-2.0
"""Scans that contradict the map: refused, until many in a row agree with each other."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.mapping.departure import Departure

#: A scan contradicts the map if less than this share of its cells stands where they may, ...
SHARE = 1.0 / 3.0
#: ... or if these depart in common by more than so many deviations: of three degrees of freedom one
#: sound scan in 7,000 does.
DEVIATIONS = 4.5
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

    def judge(self, cells: Array, found: Departure | None) -> Verdict:
        """Judge a scan by how its ground stands over the map's.

        Rocks, shadows and edges are in few cells, and wrong ground in the map is in some: only
        where a height or an attitude is beyond what is claimed do most cells, or all in common,
        depart. `AGREEING` refused scans whose heights are the same but for what their own poses
        claim win. ``cells``: (12, M) of `ScanUpdate.fit`. ``found``: of `departure`.
        """
        if not departs(found):
            self.count = 0
            return Verdict.SOUND
        height, variance = float(np.median(cells[0])), float(np.median(cells[1] + cells[2]))
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
