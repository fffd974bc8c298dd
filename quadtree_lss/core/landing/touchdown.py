# SPDX-License-Identifier: Apache-2.0
"""Touchdown check on the estimated map: the lander's four pads set down on the leaf planes.

At every node the lander stands on its pads at a number of headings. Four rigid pads on uneven
ground rock about the diagonal that carries: the plane through the higher diagonal and either of
the other two pads. Each such plane must be level enough, and no ground under the lander may rise
above it by more than the roughness limit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.config.settings import LssConfig
from quadtree_lss.core.landing.lander_ground import BLOCK, LanderGround
from quadtree_lss.core.landing.raster import TerrainRaster
from quadtree_lss.core.landing.touchdown_blocks import fails
from quadtree_lss.core.landing.touchdown_bounds import surely_safe

Mask = NDArray[np.bool_]

#: Cells of the windows of the blocks that are treated at once.
WORKING_SET = 120_000


class TouchdownCheck:
    """Checks maps of a growing terrain; remembers the last one and repeats only what changed.

    A node's verdict depends on the cells under the lander alone, so the verdict of a node none of
    whose cells changed is the one of before, bit for bit.
    """

    def __init__(self, config: LssConfig) -> None:
        self.config = config
        self._ground: LanderGround | None = None
        self._checked: Mask = np.zeros((0, 0), dtype=np.bool_)
        self._unsafe: Mask = np.zeros((0, 0), dtype=np.bool_)

    def unsafe_nodes(self, raster: TerrainRaster, candidates: Mask) -> Mask:
        """Nodes (n + 1, n + 1) at which some heading fails; False where not a candidate.

        Args:
            raster: The map on its finest cells.
            candidates: (n + 1, n + 1) nodes to check; their lander circle lies inside the domain.
        """
        ground = LanderGround(raster, self.config)
        unsafe = np.zeros(candidates.shape, dtype=np.bool_)
        due = candidates
        if self._ground is not None and self._ground.comparable(ground):
            kept = candidates & self._checked & ~_near(self._ground.differs(ground), ground.reach)
            unsafe[kept] = self._unsafe[kept]
            due = candidates & ~kept
        if due.any():
            unsafe |= _check(ground, due, self.config)
        self._ground, self._checked, self._unsafe = ground, candidates, unsafe
        return unsafe.copy()


def _near(changed: Mask, reach: int) -> Mask:
    """Nodes (n + 1, n + 1) of blocks with a changed cell (n, n) that one of their landers meets."""
    n = len(changed)
    total = np.zeros((n + 1, n + 1), dtype=np.int32)
    np.cumsum(np.cumsum(changed, axis=0, dtype=np.int32), axis=1, out=total[1:, 1:])
    first = np.arange(0, n + 1, BLOCK)
    low, high = np.maximum(first - reach, 0), np.minimum(first + BLOCK - 1 + reach, n)
    rows = total[high] - total[low]
    blocks: Mask = rows[:, high] != rows[:, low]
    nodes: Mask = blocks.repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)[: n + 1, : n + 1]
    return nodes


def _check(ground: LanderGround, due: Mask, config: LssConfig) -> Mask:
    """Verdict on the nodes that are due, all of them anew."""
    count = -(-len(due) // BLOCK)
    spare = count * BLOCK - len(due)
    by_block = np.pad(due, ((0, spare), (0, spare))).reshape(count, BLOCK, count, BLOCK)
    rows, columns = np.nonzero(by_block.any(axis=(1, 3)))
    doubtful = ~surely_safe(ground, rows * BLOCK, columns * BLOCK, config)
    rows, columns = rows[doubtful], columns[doubtful]
    unsafe = np.zeros(by_block.shape, dtype=np.bool_)
    at_once = max(WORKING_SET // ground.window**2, 1)
    for begin in range(0, len(rows), at_once):
        row, column = rows[begin : begin + at_once], columns[begin : begin + at_once]
        here = by_block[row, :, column].transpose(1, 2, 0)
        failed = fails(ground, row * BLOCK, column * BLOCK, here, config)
        unsafe[row, :, column] = failed.transpose(2, 0, 1)
    return unsafe.reshape(count * BLOCK, count * BLOCK)[: len(due), : len(due)]
