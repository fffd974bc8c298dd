# SPDX-License-Identifier: Apache-2.0
"""Scans that contradict the map: refused, until many in a row agree with each other."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from quadtree_lss.arrays import Array

#: A scan contradicts the map if more than this share of its cells ...
SHARE = 2.0 / 3.0
#: ... stand off by more than this many deviations.
DEVIATIONS = 5.0
#: What no covariance tells, m^2: half a metre is no contradiction.
SLACK = 0.1**2
#: Cells seen before that a scan needs to contradict the map.
MIN_CELLS = 3
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
    """The scans refused in a row.

    Attributes:
        count: How many.
        height, variance: Of the last one's ground over the map's, m, and how well its pose knows
            that, m^2.
    """

    count: int = 0
    height: float = 0.0
    variance: float = 0.0

    def judge(self, cells: Array) -> Verdict:
        """Judge a scan by how its ground stands over the map's.

        In each of the M cells seen before it stands off by b_i, of variance v_i: from range noise
        and from what both poses claim. Most |b_i| / sqrt(v_i) exceed `DEVIATIONS` only where a
        height or an attitude is beyond what is claimed, however rough the ground: rocks, shadows
        and edges are in few cells, and wrong ground in the map is in some. `AGREEING` refused scans
        whose b are the same but for what their own poses claim win.

        Args:
            cells: (6, M) of `ScanUpdate.compare`.
        """
        if cells.shape[1] < MIN_CELLS or not departs(cells):
            self.count = 0
            return Verdict.SOUND
        height, variance = float(np.median(cells[0])), float(np.median(cells[2]))
        allowed = DEVIATIONS**2 * (variance + self.variance + SLACK)
        agrees = self.count > 0 and (height - self.height) ** 2 <= allowed
        self.count = self.count + 1 if agrees else 1
        self.height, self.variance = height, variance
        if self.count < AGREEING:
            return Verdict.REFUSED
        self.count = 0
        return Verdict.OVERRULES


def departs(cells: Array, lifted: float = 0.0) -> bool:
    """Whether a scan contradicts a map lifted by so many m."""
    deviations = np.abs(cells[0] - lifted) / np.sqrt(cells[1] + cells[2] + cells[3] + SLACK)
    return float(np.mean(deviations > DEVIATIONS)) > SHARE
