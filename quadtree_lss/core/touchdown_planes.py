# SPDX-License-Identifier: Apache-2.0
"""Nodes tried heading by heading: the lander's resting planes against slope and ground."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core.config import LssConfig
from quadtree_lss.core.lander_ground import LanderGround
from quadtree_lss.core.touchdown_bounds import ROUNDING

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]

#: Nodes tried at once, so that the working set stays small.
NODES = 1024


@dataclass(frozen=True)
class Doubtful:
    """Nodes (K,) that bounds over all headings did not settle.

    Attributes:
        row, column: Of the nodes.
        roof: No ground under the lander is higher than the plane of this height at the node with
            the following slopes, m.
        slope_x, slope_y: dz/dx, dz/dy of that plane.
    """

    row: Index
    column: Index
    roof: Single
    slope_x: Single
    slope_y: Single

    @classmethod
    def join(cls, parts: list[Doubtful]) -> Doubtful:
        """All of them in one."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))

    def part(self, chosen: slice | Index) -> Doubtful:
        """Some of them."""
        return Doubtful(*(getattr(self, f.name)[chosen] for f in fields(self)))


def fails(ground: LanderGround, nodes: Doubtful, lss: LssConfig) -> Mask:
    """Nodes (K,) at which some heading is too steep or has ground too high above it."""
    out = np.zeros(len(nodes.row), dtype=np.bool_)
    for begin in range(0, len(out), NODES):
        part = slice(begin, begin + NODES)
        out[part] = _fails(ground, nodes.part(part), lss)
    return out


def _fails(ground: LanderGround, nodes: Doubtful, lss: LssConfig) -> Mask:
    """Slope exactly; height by bounds, which leave (node, heading) pairs to ``_ground_above``.

    A resting plane stands ``centre`` high at the node. Along the diagonal that carries it has that
    diagonal's slope; along the other, the difference of that one's pads with their lack of height
    (``gap``) added or taken off. Times two radii, in the frame of the heading: (east, north -+ gap)
    or (east -+ gap, north). What the slope differs by from the roof's moves the plane at the rim.
    """
    radius, limit = ground.radius, np.float32(lss.touchdown_roughness)
    cell = ground.cell_of(nodes.row, nodes.column)
    stands = ground.stands(cell)
    east, north = stands[0] - stands[2], stands[1] - stands[3]
    by_east, by_north = stands[0] + stands[2], stands[1] + stands[3]
    centre = np.float32(0.5) * np.maximum(by_east, by_north)
    gap_east, gap_north = np.maximum(by_north - by_east, 0), np.maximum(by_east - by_north, 0)
    steep = np.float32((2.0 * radius * np.tan(np.radians(lss.touchdown_slope_deg))) ** 2)
    too_steep = _greatest(east, north, gap_east, gap_north) > steep
    failed = np.asarray(too_steep.any(axis=0), dtype=np.bool_)
    cos, sin = (np.float32(2.0 * radius) * v[:, None] for v in (ground.feet.cos, ground.feet.sin))
    east -= nodes.slope_x * cos + nodes.slope_y * sin
    north -= nodes.slope_y * cos - nodes.slope_x * sin
    far = np.float32(0.5 * max(1.0, np.hypot(ground.under.x, ground.under.y).max() / radius))
    over = nodes.roof - centre - limit
    moved = far * np.sqrt(_greatest(east, north, gap_east, gap_north))
    doubt = over + moved > -ROUNDING
    moved = far * np.sqrt(_least(east, north, gap_east, gap_north))
    failed |= (over - moved > ROUNDING).any(axis=0)
    doubt &= ~failed
    open_ = np.flatnonzero(doubt.any(axis=0))
    if len(open_):
        node, heading = np.nonzero(doubt[:, open_].T)
        planes = _resting_planes(ground, stands[:, heading, open_[node]], heading)
        failed[open_] = _ground_above(ground, cell[open_], np.tile(node, 2), planes, limit)
    return failed


def _greatest(east: Single, north: Single, gap_east: Single, gap_north: Single) -> Single:
    """Square of the longer one of each heading's two slopes."""
    x, y = np.abs(east) + gap_east, np.abs(north) + gap_north
    out: Single = x * x + y * y
    return out


def _least(east: Single, north: Single, gap_east: Single, gap_north: Single) -> Single:
    """Square of the shorter one of each heading's two slopes."""
    x, y = np.abs(east) - gap_east, np.abs(north) - gap_north
    out: Single = x * x + y * y
    return out


def _resting_planes(ground: LanderGround, stands: Single, heading: Index) -> Single:
    """Height at the node and slopes in x and y, (3, 2 K): each pair's first plane, then the second.

    Args:
        ground: Only its lander is used.
        stands: (4, K) heights of the pads.
        heading: (K,) number of the heading.
    """
    east, north, west, south = stands
    half, inverse = np.float32(0.5), np.float32(1.0 / ground.radius)
    cos, sin = ground.feet.cos[heading], ground.feet.sin[heading]
    carried = east + west >= north + south
    centre = half * np.maximum(east + west, north + south)
    own = half * inverse * np.where(carried, east - west, north - south)
    ahead = (np.where(carried, north, east) - centre) * inverse
    behind = (centre - np.where(carried, south, west)) * inverse
    out = []
    for other in (ahead, behind):
        along, across = np.where(carried, own, other), np.where(carried, other, own)
        out.append(np.stack([centre, along * cos - across * sin, along * sin + across * cos]))
    return np.concatenate(out, axis=1)


def _ground_above(
    ground: LanderGround, cell: Index, node: Index, planes: Single, limit: np.float32
) -> Mask:
    """Nodes (K,) with ground more than ``limit`` above one of their planes.

    The cell that stands highest over the mean of a node's planes mostly decides: where it is too
    high the node fails, where its height plus the planes' distance is not, the plane is cleared.
    What is left is compared with every cell.

    Args:
        ground: The ground.
        cell: (K,) ``cell_of`` the nodes.
        node: (P,) place among the nodes of each plane.
        planes: (3, P) height at the node, slopes.
        limit: m.
    """
    under = ground.under
    x, y = under.x.astype(np.float32), under.y.astype(np.float32)
    tops = ground.top.ravel().take(cell[:, None] + (under.row * ground.stride + under.column))
    count = np.bincount(node, minlength=len(cell))
    mean = np.stack([np.bincount(node, part) / count for part in planes]).astype(np.float32)
    over_mean = _above(tops, mean, x, y)
    best = np.argmax(over_mean, axis=1)
    each = np.arange(len(cell))
    failed = np.zeros(len(cell), dtype=np.bool_)
    high = (
        tops[each, best][node] - planes[0] - planes[1] * x[best][node] - planes[2] * y[best][node]
    )
    failed[node[high > limit + ROUNDING]] = True
    apart = mean[:, node] - planes
    far = np.float32(np.hypot(under.x, under.y).max())
    bound = over_mean[each, best][node] + apart[0] + far * np.hypot(apart[1], apart[2])
    left = np.flatnonzero((bound > limit - ROUNDING) & ~failed[node])
    for begin in range(0, len(left), NODES):
        pick = left[begin : begin + NODES]
        above = _above(tops[node[pick]], planes[:, pick], x, y)
        failed[node[pick[above.max(axis=1) > limit]]] = True
    return failed


def _above(tops: Single, plane: Single, x: Single, y: Single) -> Single:
    """Heights (K, C) of cells over planes (3, K); x, y (C,) of the cells from the node, m."""
    out: Single = plane[1][:, None] * x
    out += plane[2][:, None] * y
    np.subtract(tops, out, out=out)
    out -= plane[0][:, None]
    return out
