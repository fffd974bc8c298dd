# SPDX-License-Identifier: Apache-2.0
"""Resting planes of single (node, heading) pairs against the ground, at last cell by cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.config.settings import LssConfig
from quadtree_lss.core.landing.lander_ground import LanderGround

Single = NDArray[np.float32]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]

#: Nodes or planes compared with every cell at once, so that the working set stays small.
NODES = 256
#: Bounds settle a pair only by more than single precision can err, m.
ROUNDING = np.float32(1e-4)


@dataclass(frozen=True)
class Pairs:
    """Headings (P,) at nodes that may fail.

    Attributes:
        node: Place of the node among those checked.
        heading: Number of the heading.
        stands: (4, P) heights of the pads, m.
        roof: (4, P) no ground under the lander's south-western, south-eastern, north-western,
            north-eastern quarter is higher than the plane of this height at the node, m, ...
        slope_x, slope_y: ... with these slopes.
    """

    node: Index
    heading: Index
    stands: Single
    roof: Single
    slope_x: Single
    slope_y: Single


def settle(ground: LanderGround, cell: Index, pairs: Pairs, failed: Mask, lss: LssConfig) -> None:
    """Set ``failed`` (K,) of nodes that have ground too high above a resting plane.

    Args:
        ground: The ground.
        cell: (K,) ``cell_of`` the nodes.
        pairs: What to compare.
        failed: Changed in place.
        lss: Limits.
    """
    limit = np.float32(lss.touchdown_roughness)
    left = []
    for planes in _resting_planes(ground, pairs):
        low, high = _quarters_above(pairs, planes, np.float32(ground.farthest))
        failed[pairs.node[low > limit + ROUNDING]] = True
        open_ = np.flatnonzero(high > limit - ROUNDING)
        left.append((pairs.node[open_], planes[:, open_]))
    node = np.concatenate([part for part, _ in left])
    planes = np.concatenate([part for _, part in left], axis=1)
    open_ = np.flatnonzero(~failed[node])
    if len(open_):
        _compare(ground, cell, node[open_], planes[:, open_], failed, limit)


def _resting_planes(ground: LanderGround, pairs: Pairs) -> tuple[Single, Single]:
    """Height at the node and slopes in x and y, (3, P), of the two planes of each pair."""
    east, north, west, south = pairs.stands
    half, inverse = np.float32(0.5), np.float32(1.0 / ground.radius)
    cos, sin = ground.feet.cos[pairs.heading], ground.feet.sin[pairs.heading]
    carried = east + west >= north + south
    centre = half * np.maximum(east + west, north + south)
    own = half * inverse * np.where(carried, east - west, north - south)
    ahead = (np.where(carried, north, east) - centre) * inverse
    behind = (centre - np.where(carried, south, west)) * inverse
    along, across = np.where(carried, own, ahead), np.where(carried, ahead, own)
    one = np.stack([centre, along * cos - across * sin, along * sin + across * cos])
    along, across = np.where(carried, own, behind), np.where(carried, behind, own)
    return one, np.stack([centre, along * cos - across * sin, along * sin + across * cos])


def _quarters_above(pairs: Pairs, planes: Single, farthest: np.float32) -> tuple[Single, Single]:
    """Bounds (P,) on the greatest height of ground over planes (3, P).

    Over a quarter of the lander, a plane stands over another through the same point by
    ``farthest`` times the positive parts of the slopes' differences along its two edges at most.
    """
    x, y = planes[1] - pairs.slope_x, planes[2] - pairs.slope_y
    zero = np.float32(0.0)
    west, east = np.square(np.minimum(x, zero)), np.square(np.maximum(x, zero))
    south, north = np.square(np.minimum(y, zero)), np.square(np.maximum(y, zero))
    rises = [farthest * np.sqrt(a + b) for b in (south, north) for a in (west, east)]
    low = np.full(x.shape, -np.inf, dtype=np.float32)
    high = low.copy()
    for quarter, rise in enumerate(rises):
        over = pairs.roof[quarter] - planes[0]
        np.maximum(low, over - rise, out=low)
        # Where the resting plane falls in this quarter it rises in the opposite one.
        np.maximum(high, over + rises[3 - quarter], out=high)
    return low, high


def _compare(
    ground: LanderGround,
    cell: Index,
    node: Index,
    planes: Single,
    failed: Mask,
    limit: np.float32,
) -> None:
    """Compare planes (3, P) at nodes (P,) with the cells; sets ``failed`` (K,).

    The cell that stands highest over the mean of a node's planes mostly decides: where it is too
    high the node fails, where its height plus the planes' distance is not, the plane is cleared.
    What is left is compared with every cell.
    """
    order = np.argsort(node, kind="stable")
    node, planes = node[order], planes[:, order]
    nodes = np.flatnonzero(np.bincount(node))
    first = np.append(np.searchsorted(node, nodes), len(node))
    under = ground.under
    x, y = under.x.astype(np.float32), under.y.astype(np.float32)
    offset = under.row * ground.stride + under.column
    for begin in range(0, len(nodes), NODES):
        chosen = nodes[begin : begin + NODES]
        start = first[begin : begin + len(chosen) + 1]
        count = np.diff(start)
        of_plane = np.repeat(np.arange(len(chosen)), count)
        some = planes[:, start[0] : start[-1]]
        tops = ground.top.ravel().take(cell[chosen, None] + offset)
        total = np.add.reduceat(some, start[:-1] - start[0], axis=1)
        mean: Single = (total / count).astype(np.float32)
        over_mean = _above(tops, mean, x, y)
        best = np.argmax(over_mean, axis=1)
        each = np.arange(len(chosen))
        high = tops[each, best][of_plane] - some[0]
        high -= some[1] * x[best][of_plane] + some[2] * y[best][of_plane]
        too_high = np.zeros(len(chosen), dtype=np.bool_)
        too_high[of_plane[high > limit + ROUNDING]] = True
        apart = mean[:, of_plane] - some
        bound = np.float32(ground.farthest) * np.sqrt(apart[1] ** 2 + apart[2] ** 2)
        bound += over_mean[each, best][of_plane] + apart[0]
        left = np.flatnonzero((bound > limit - ROUNDING) & ~too_high[of_plane])
        for part in range(0, len(left), NODES):
            pick = left[part : part + NODES]
            above = _above(tops[of_plane[pick]], some[:, pick], x, y)
            too_high[of_plane[pick[above.max(axis=1) > limit]]] = True
        failed[chosen[too_high]] = True


def _above(tops: Single, plane: Single, x: Single, y: Single) -> Single:
    """Heights (K, C) of cells over planes (3, K); x, y (C,) of the cells from the node, m."""
    out: Single = plane[1][:, None] * x
    out += plane[2][:, None] * y
    np.subtract(tops, out, out=out)
    out -= plane[0][:, None]
    return out
