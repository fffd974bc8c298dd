# SPDX-License-Identifier: Apache-2.0
"""A map of scans at the heights that their poses say."""

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.mapping.update import ScanUpdate


class AsPosed(Mapper):
    """Scan and map are not brought to one height."""

    def _align(self, change: ScanUpdate, cells: Array, now: float) -> float:
        return 0.0
