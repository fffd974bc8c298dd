# SPDX-License-Identifier: Apache-2.0
"""The touchdown check of blocks of nodes: slope exactly, height by bounds that settle most.

Heights of ``BLOCK`` by ``BLOCK`` nodes and of the ground around them lie in arrays (row, column,
block), so that what stands at an offset from every node is a slice of them.

Over a block there is a reference plane near the ground, and for each node the highest ground under
each quarter of the lander over it: the roof. A resting plane through ``centre`` at the node whose
slopes differ from the reference by s leaves at most roof - centre + farthest |s|, and at least
roof - centre - farthest |s|, above itself. What these bounds leave open for a (node, heading) pair
is settled by ``touchdown_planes``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.config.settings import LssConfig
from quadtree_lss.core.landing.lander_ground import BLOCK, LanderGround
from quadtree_lss.core.landing.touchdown_planes import ROUNDING, Pairs, settle

Single = NDArray[np.float32]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]

#: Headings that are treated at once.
HEADINGS = 3


def fails(ground: LanderGround, rows: Index, columns: Index, due: Mask, lss: LssConfig) -> Mask:
    """Which of the nodes ``due`` (BLOCK, BLOCK, B) fail at some heading.

    Args:
        ground: The ground.
        rows, columns: (B,) of each block's first node.
        due: Nodes to check; others are False.
        lss: Limits.
    """
    cells = ground.window_cells(rows, columns)
    reference = _reference(ground, cells)
    pads = [v.ravel().take(cells) for v in (ground.pad, ground.slope_x, ground.slope_y)]
    failed = np.ascontiguousarray(~due)
    found = []
    for begin in range(0, lss.touchdown_yaws, HEADINGS):
        headings = slice(begin, min(begin + HEADINGS, lss.touchdown_yaws))
        stands = _stands(ground, pads, headings)
        doubt = _by_bounds(ground, reference, stands, headings, failed, lss)
        pair = np.flatnonzero(doubt & ~failed)
        found.append((pair + begin * due.size, stands.reshape(4, -1).take(pair, axis=1)))
    heading, node = np.divmod(np.concatenate([pair for pair, _ in found]), due.size)
    left = np.flatnonzero(~failed.ravel()[node])
    node = node[left]
    block = node % len(rows)
    pairs = Pairs(
        node,
        heading[left],
        np.concatenate([stands for _, stands in found], axis=1).take(left, axis=1),
        reference.roof.reshape(4, -1).take(node, axis=1),
        reference.slope_x[block],
        reference.slope_y[block],
    )
    step = np.arange(BLOCK)[:, None]
    cell = ground.cell_of(rows + step[:, None], columns + step)
    settle(ground, cell.ravel(), pairs, failed.reshape(-1), lss)
    return failed & due


@dataclass(frozen=True)
class _Reference:
    """Planes that heights are compared with.

    Attributes:
        slope_x, slope_y: (B,) of each block's plane.
        roof: (4, BLOCK, BLOCK, B) no ground under the lander's south-western, south-eastern,
            north-western, north-eastern quarter is higher than the plane of this height at the
            node with the block's slopes, m.
    """

    slope_x: Single
    slope_y: Single
    roof: Single


def _reference(ground: LanderGround, cells: Index) -> _Reference:
    """Least squares over the window; any plane would do, one near the ground bounds best."""
    top = ground.top.ravel().take(cells)
    width = len(cells)
    x = ((np.arange(width) - 0.5 * (width - 1)) * ground.side).astype(np.float32)
    norm = np.float32(width) * np.sum(x * x)
    slope_x: Single = x @ top.sum(axis=0) / norm
    slope_y: Single = x @ top.sum(axis=1) / norm
    top -= x[:, None] * slope_x
    top -= x[:, None, None] * slope_y
    roof = _highest_under(ground, top)
    node = x[ground.reach : ground.reach + BLOCK] - np.float32(0.5 * ground.side)
    roof += node[:, None] * slope_x
    roof += node[:, None, None] * slope_y
    return _Reference(slope_x, slope_y, roof)


def _highest_under(ground: LanderGround, top: Single) -> Single:
    """Greatest height (4, BLOCK, BLOCK, B) of the cells under each quarter of the lander.

    A disc is a stack of runs of cells; each half of a run serves its own quarter.
    """
    reach = ground.reach
    runs = np.full((2, top.shape[0], BLOCK, top.shape[2]), -np.inf, dtype=np.float32)
    out = np.full((4, BLOCK, BLOCK, top.shape[2]), -np.inf, dtype=np.float32)
    for half, rows in ground.under.runs:
        for east, column in enumerate((reach - half, reach + half - 1)):
            np.maximum(runs[east], top[:, column : column + BLOCK], out=runs[east])
            for row in rows:
                quarter = out[2 * (row >= 0) + east]
                np.maximum(quarter, runs[east, reach + row : reach + row + BLOCK], out=quarter)
    return out


def _stands(ground: LanderGround, pads: list[Single], headings: slice) -> Single:
    """Height (4, H, BLOCK, BLOCK, B) of the pads about each node, m.

    Args:
        ground: The ground.
        pads: Windows (window, window, B) of ``pad``, ``slope_x``, ``slope_y``.
        headings: H of them.
    """
    feet, reach = ground.feet, ground.reach
    pad, slope_x, slope_y = pads
    places = [part[:, headings] for part in (feet.row, feet.column, feet.dx, feet.dy)]
    out = np.empty((*places[0].shape, BLOCK, BLOCK, pad.shape[2]), dtype=np.float32)
    stands = out.reshape(-1, *out.shape[2:])
    work = np.empty_like(stands[0])
    each = (part.ravel().tolist() for part in places)
    for stand, up, right, dx, dy in zip(stands, *each, strict=True):
        rows = slice(reach + up, reach + up + BLOCK)
        columns = slice(reach + right, reach + right + BLOCK)
        np.multiply(slope_x[rows, columns], dx, out=stand)
        np.multiply(slope_y[rows, columns], dy, out=work)
        stand += work
        stand += pad[rows, columns]
    return out


def _by_bounds(
    ground: LanderGround,
    reference: _Reference,
    stands: Single,
    headings: slice,
    failed: Mask,
    lss: LssConfig,
) -> Mask:
    """Pairs (H, BLOCK, BLOCK, B) that may fail; sets ``failed`` (BLOCK, BLOCK, B) of those that do.

    A resting plane stands ``centre`` high at the node. Along the diagonal that carries it has that
    diagonal's slope; along the other, the difference of that one's pads with their lack of height
    (``gap``) added or taken off. Times two radii, in the frame of the heading: (east, north -+ gap)
    or (east -+ gap, north).
    """
    diameter = np.float32(2.0 * ground.radius)
    steep = np.square(diameter * np.float32(np.tan(np.radians(lss.touchdown_slope_deg))))
    far = np.float32(ground.farthest) / diameter
    roof = reference.roof.max(axis=0) - np.float32(lss.touchdown_roughness)
    feet = (diameter * v[headings, None, None, None] for v in (ground.feet.cos, ground.feet.sin))
    cos, sin = feet
    feet_east, feet_north, feet_west, feet_south = stands
    by_east, by_north = feet_east + feet_west, feet_north + feet_south
    centre = np.maximum(by_east, by_north)
    gap_east, gap_north = centre - by_east, centre - by_north
    centre *= np.float32(0.5)
    east, north = feet_east - feet_west, feet_north - feet_south
    failed |= (_square(east, north, gap_east, gap_north) > steep).any(axis=0)
    east -= reference.slope_x * cos + reference.slope_y * sin
    north -= reference.slope_y * cos - reference.slope_x * sin
    over = np.subtract(roof, centre, out=centre)
    moved = np.sqrt(_square(east, north, gap_east, gap_north))
    moved *= far
    doubt: Mask = over + moved > -ROUNDING
    failed |= (over - moved > ROUNDING).any(axis=0)
    return doubt


def _square(east: Single, north: Single, gap_east: Single, gap_north: Single) -> Single:
    """Square of the longer one of each heading's two slopes, times a diameter."""
    x, y = np.abs(east), np.abs(north)
    x += gap_east
    y += gap_north
    x *= x
    y *= y
    x += y
    return x
