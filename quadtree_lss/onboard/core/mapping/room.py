# SPDX-License-Identifier: Apache-2.0
"""Memory for what is found of one scan, kept for the next.

To ask for it anew and to tell what its records are took a twentieth of a scan.
"""

from __future__ import annotations

import cython
import numpy as np

from quadtree_lss.onboard.core.mapping.features import Heights
from quadtree_lss.onboard.core.mapping.measure import RUN

#: Of larger scans no memory is kept.
KEPT_POINTS = 1 << 20


class Room:
    """Room for a scan's points and for its cells; what was in it is lost as it grows.

    Attributes:
        begins, rows: Of each cell, the first of its points, and its row in the table.
        residual: Of each point, m.
        ratio: (2, N) of cells that tell the range noise.
        heights: For the feature of a cell.
        runs: Records of type `RUN`, one for each cell.
    """

    def __init__(self) -> None:
        self.points = self.cells = -1

    def hold(self, points: cython.Py_ssize_t) -> None:
        """Have room for so many points."""
        if points > self.points:
            self.points = points
            self.begins, self.rows = np.empty((2, points + 1), dtype=np.intp)
            self.residual = np.empty(points)
            self.ratio = np.empty((2, points))
            self.ratios, self.weights = self.ratio
            self.heights = Heights(points)

    def hold_runs(self, cells: cython.Py_ssize_t) -> None:
        """Have room for the records of so many cells."""
        if cells > self.cells:
            self.cells = 2 * cells
            runs = np.empty(self.cells, dtype=RUN)
            self.runs = runs if cython.compiled else runs.view(np.recarray)
