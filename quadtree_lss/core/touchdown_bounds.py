# SPDX-License-Identifier: Apache-2.0
"""What can be said of a landing without trying a heading: bounds on pads and ground.

Nodes are treated in blocks of ``BLOCK`` by ``BLOCK``, which share a tilted reference plane; heights
over it vary little. With all pads of all headings between ``lowest`` and ``highest`` over the
reference, and nothing under the lander higher than ``roof`` over it:

A resting plane holds both ends of a diagonal, at c on average and not lower than the other two,
and one pad of the other. At a point of the circle, alpha and beta radii along the two diagonals,
it stands at c (1 - alpha - beta) + alpha e + beta n, with e and n pads or the mirrored images of
lower ones. Hence, with h = highest - lowest and alpha + beta <= sqrt 2,

    plane >= lowest - h (sqrt 2 - 1) / 2,        |slope - reference slope| <= h / radius,

and of the planes of the heading nearest to a point's direction (half a step s off it at the most)
one has plane <= highest + h (cos s + sin s - 1) there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core.config import LssConfig
from quadtree_lss.core.lander_ground import SPARE, LanderGround

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]

#: Side of the blocks of nodes that share a reference plane.
BLOCK = SPARE
#: Bounds settle a node only by more than single precision can err, m.
ROUNDING = np.float32(1e-4)


@dataclass(frozen=True)
class BlockBounds:
    """Of B blocks of nodes, (BLOCK, BLOCK, B), single precision.

    Attributes:
        slope_x, slope_y: (B,) of the reference plane.
        roof: Highest ground under the lander over the reference plane through the node, m.
        safe: True where every heading passes.
        unsafe: True where some heading fails.
    """

    slope_x: Single
    slope_y: Single
    roof: Single
    safe: Mask
    unsafe: Mask


def block_bounds(ground: LanderGround, rows: Index, columns: Index, lss: LssConfig) -> BlockBounds:
    """Bounds of the blocks whose first nodes are (rows, columns), (B,)."""
    width = BLOCK - 1 + 2 * ground.reach
    offset = np.arange(width)
    corner = ground.cell_of(rows - ground.reach, columns - ground.reach)
    window = corner + (offset[:, None] * ground.stride + offset)[..., None]
    pad, top = ground.pad.ravel().take(window), ground.top.ravel().take(window)
    rise = ground.rise.ravel().take(window)
    # Least squares over the window; any plane would do, one near the ground bounds best.
    x = ((offset - 0.5 * (width - 1)) * ground.side).astype(np.float32)
    norm = np.float32(width) * np.sum(x * x)
    slope_x: Single = x @ pad.sum(axis=0) / norm
    slope_y: Single = x @ pad.sum(axis=1) / norm
    along_x, along_y = x[:, None] * slope_x, x[:, None, None] * slope_y
    for part in (pad, top):
        part -= along_x
        part -= along_y
    nodes = ((np.arange(BLOCK) - 0.5 * (BLOCK - 1)) * ground.side).astype(np.float32)
    lowest, highest = _pads(ground, pad - rise, pad + rise)
    off_centre = np.float32(0.5 * ground.side) * (np.abs(slope_x) + np.abs(slope_y))
    lowest -= off_centre
    highest += off_centre
    roof = _highest_under(ground, top)
    safe, unsafe = _settled(ground, lss, np.hypot(slope_x, slope_y), lowest, highest, roof)
    roof += nodes[:, None] * slope_x
    roof += nodes[:, None, None] * slope_y
    return BlockBounds(slope_x, slope_y, roof, safe, unsafe)


def _pads(ground: LanderGround, low: Single, high: Single) -> tuple[Single, Single]:
    """Least and greatest height of the cells that pads can stand on."""
    lowest = np.full((BLOCK, BLOCK, low.shape[2]), np.inf, dtype=np.float32)
    highest = -lowest
    for row, column in zip(*ground.feet.cells(), strict=True):
        r, c = row + ground.reach, column + ground.reach
        np.minimum(lowest, low[r : r + BLOCK, c : c + BLOCK], out=lowest)
        np.maximum(highest, high[r : r + BLOCK, c : c + BLOCK], out=highest)
    return lowest, highest


def _highest_under(ground: LanderGround, top: Single) -> Single:
    """Greatest height of the cells under the lander: a disc is a stack of centred runs of cells."""
    reach = ground.reach
    run = np.full((top.shape[0], BLOCK, top.shape[2]), -np.inf, dtype=np.float32)
    out = np.full((BLOCK, BLOCK, top.shape[2]), -np.inf, dtype=np.float32)
    for half, rows in ground.under.runs:
        for column in (reach - half, reach + half - 1):
            np.maximum(run, top[:, column : column + BLOCK], out=run)
        for row in rows:
            np.maximum(out, run[reach + row : reach + row + BLOCK], out=out)
    return out


def _settled(
    ground: LanderGround,
    lss: LssConfig,
    tilt: Single,
    lowest: Single,
    highest: Single,
    roof: Single,
) -> tuple[Mask, Mask]:
    """Nodes that pass at every heading, and nodes that fail at some."""
    limit = np.float32(lss.touchdown_roughness)
    steepest = np.float32(np.tan(np.radians(lss.touchdown_slope_deg)))
    # 1, but for landers smaller than a cell.
    far = max(1.0, float(np.hypot(ground.under.x, ground.under.y).max()) / ground.radius)
    sag = 0.5 * (np.sqrt(2.0) - 1.0) if far == 1.0 else np.sqrt(2.0) * far - 1.0
    step = ground.feet.half_step
    lift = max(far * (np.cos(step) + np.sin(step)) - 1.0, 0.0)
    spread = highest - lowest
    safe = roof - lowest + np.float32(sag) * spread <= limit - ROUNDING
    safe &= tilt + spread * np.float32(1.0 / ground.radius) <= steepest - ROUNDING
    unsafe: Mask = roof - highest - np.float32(lift) * spread > limit + ROUNDING
    return safe, unsafe
