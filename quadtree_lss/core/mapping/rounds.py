# SPDX-License-Identifier: Apache-2.0
"""The cells that a scan's points lie in, and the points, on their way through the leaves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core.geometry.planes import Moments

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class Round:
    """Cells that have points: first all that the scan touches, then only new children.

    Attributes:
        rows: (M,) leaves.
        group: (N,) place of each point's leaf among them.
        index: (N,) which of the pass's points these are.
        points: (3, N) about the scan's origin, m.
        moment: Of the M groups.
        centre: (M, 2) cell centres about the scan's origin, m.
    """

    rows: Index
    group: Index
    index: Index
    points: Array
    moment: Moments
    centre: Array
