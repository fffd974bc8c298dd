# SPDX-License-Identifier: Apache-2.0
"""Touchdown check on the estimated map: the lander's four pads set down on the leaf planes.

At every node the lander stands on its pads at a number of headings. Four rigid pads on uneven
ground rock about the diagonal that carries: the plane through the higher diagonal and either of
the other two pads. Each such plane must be level enough, and no ground under the lander may rise
above it by more than the roughness limit.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core.bump import SHAPE
from quadtree_lss.core.config import LssConfig
from quadtree_lss.core.nodes import Disc, NodePlanes, disc, distance_to
from quadtree_lss.core.terrain_raster import TerrainRaster

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]

#: Nodes compared with the ground at once, so that the working set stays small.
NODES = 1024
#: Bounds clear a plane only by more than single precision can err, m.
ROUNDING = np.float32(1e-4)
LEVEL_STEP = 64.0
#: Side of the blocks of nodes that share a bound.
BLOCK = 4


class TouchdownCheck:
    """Checks maps of a growing terrain; remembers the last one and repeats only what changed.

    A node's verdict depends on the cells under the lander alone, so the verdict of a node none of
    whose cells changed is the one of before, bit for bit.
    """

    def __init__(self, config: LssConfig) -> None:
        self.config = config
        self._ground: _Ground | None = None
        self._checked: Mask = np.zeros((0, 0), dtype=np.bool_)
        self._unsafe: Mask = np.zeros((0, 0), dtype=np.bool_)

    def unsafe_nodes(self, raster: TerrainRaster, planes: NodePlanes, candidates: Mask) -> Mask:
        """Nodes (n + 1, n + 1) at which some heading fails; False where not a candidate.

        Args:
            raster: The map on its finest cells.
            planes: Lander-scale planes of the same raster, any radius; they only bound the search.
            candidates: (n + 1, n + 1) nodes to check; their lander circle lies inside the domain.
        """
        ground = _Ground(raster, self.config)
        unsafe = np.zeros(candidates.shape, dtype=np.bool_)
        due = candidates
        if self._ground is not None and self._ground.comparable(ground):
            stale = distance_to(self._ground.differs(ground), ground.side) <= ground.radius + 1e-6
            kept = candidates & self._checked & ~stale
            unsafe[kept] = self._unsafe[kept]
            due = candidates & ~kept
        if due.any():
            unsafe |= _unsafe_nodes(ground, planes, due, self.config)
        self._ground, self._checked, self._unsafe = ground, candidates, unsafe
        return unsafe.copy()


def _unsafe_nodes(ground: _Ground, planes: NodePlanes, candidates: Mask, config: LssConfig) -> Mask:
    """Verdict on the candidates, all of them anew.

    Every node is tried at every heading for slope; for roughness a bound clears most (node,
    resting plane) pairs, and only the others are compared with the ground cell by cell.
    """
    rows, columns = _extent(candidates)
    over = disc(ground.radius, ground.side)
    roof = _Roof(ground, planes, rows, columns)
    steep = np.float32(np.tan(np.radians(config.touchdown_slope_deg)) ** 2)
    limit = np.float32(config.touchdown_roughness)
    failed = ~candidates[rows, columns]
    doubts: list[tuple[Index, Single]] = []
    for number, (centre, slope_x, slope_y) in enumerate(ground.resting_planes(rows, columns)):
        failed |= slope_x * slope_x + slope_y * slope_y > steep
        bound = roof.above(centre, slope_x, slope_y)
        doubt = np.flatnonzero((bound > limit - ROUNDING) & ~failed)
        if len(doubt):
            plane = (centre.ravel()[doubt], slope_x.ravel()[doubt], slope_y.ravel()[doubt])
            doubts.append((doubt, np.stack(plane)))
        if number == 1:
            # The first heading settles most of the hazardous nodes for all others.
            _compare(ground, over, rows, columns, failed, doubts, limit)
            doubts = []
    _compare(ground, over, rows, columns, failed, doubts, limit)
    unsafe = np.zeros(candidates.shape, dtype=np.bool_)
    unsafe[rows, columns] = failed & candidates[rows, columns]
    return unsafe


def _extent(candidates: Mask) -> tuple[slice, slice]:
    """Rows and columns of the smallest window that holds all candidates."""
    rows = np.flatnonzero(candidates.any(axis=1))
    columns = np.flatnonzero(candidates.any(axis=0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


class _Ground:
    """Heights that the lander meets, over a round level; a border of cells is repeated outside.

    Attributes:
        radius: Of the lander's circle, m.
        side: Of a finest cell, m.
        level: Height that all others are over, in steps of 64 m: small numbers round finely, and
            the same ground rounds alike while the map grows.
        border: Cells repeated on every side.
        pad: Height of a pad at each cell's centre: it stands on the highest ground within its
            radius.
        slope_x, slope_y: dz/dx, dz/dy of each cell.
        top: Highest ground of each cell: plane, its rise to the corner, subscale feature (a bell
            fitted to part of a rock is low, so its own peak counts and not the boulder's).
    """

    def __init__(self, raster: TerrainRaster, config: LssConfig) -> None:
        self.radius = 0.5 * config.vehicle_diameter
        self.yaws = config.touchdown_yaws
        self.side = raster.domain.finest_size
        self.level = LEVEL_STEP * float(np.rint(np.mean(raster.elevation) / LEVEL_STEP))
        self.border = int(np.ceil(self.radius / self.side)) + 2 * BLOCK
        height = raster.elevation - self.level
        rise = 0.5 * self.side * (np.abs(raster.slope_x) + np.abs(raster.slope_y))
        tilt = np.hypot(raster.slope_x, raster.slope_y)
        self.pad = self._bordered(height + config.pad_radius * tilt)
        self.slope_x = self._bordered(raster.slope_x)
        self.slope_y = self._bordered(raster.slope_y)
        self.top = self._bordered(height + rise + SHAPE * raster.subscale)

    def comparable(self, other: _Ground) -> bool:
        """True if both lie on the same cells and level."""
        return (self.side, self.level, self.top.shape) == (other.side, other.level, other.top.shape)

    def differs(self, other: _Ground) -> Mask:
        """Cells (n, n) whose heights differ."""
        out: Mask = self.top != other.top
        out |= self.pad != other.pad
        out |= self.slope_x != other.slope_x
        out |= self.slope_y != other.slope_y
        return out[self.border : -self.border, self.border : -self.border]

    def _bordered(self, values: Array) -> Single:
        return np.pad(values, self.border, mode="edge").astype(np.float32)

    def _window(self, values: Single, rows: slice, columns: slice, up: int, right: int) -> Single:
        """Cells at an offset from each node of a window."""
        up, right = up + self.border, right + self.border
        return values[
            rows.start + up : rows.stop + up, columns.start + right : columns.stop + right
        ]

    def _stand(self, rows: slice, columns: slice, x: float, y: float) -> Single:
        """Height that a pad at offset (x, y) from each node of a window stands on, m."""
        right, up = int(np.floor(x / self.side)), int(np.floor(y / self.side))
        dx = np.float32(x - (right + 0.5) * self.side)
        dy = np.float32(y - (up + 0.5) * self.side)
        out = self._window(self.slope_x, rows, columns, up, right) * dx
        out += self._window(self.slope_y, rows, columns, up, right) * dy
        out += self._window(self.pad, rows, columns, up, right)
        return out

    def resting_planes(
        self, rows: slice, columns: slice
    ) -> Iterator[tuple[Single, Single, Single]]:
        """Height at the node and the two slopes of each plane that the lander can rest on."""
        r = self.radius
        half, inverse = np.float32(0.5), np.float32(1.0 / r)
        for yaw in np.arange(self.yaws) * (0.5 * np.pi / self.yaws):
            c, s = np.float32(np.cos(yaw)), np.float32(np.sin(yaw))
            east, north, west, south = (
                self._stand(rows, columns, r * float(x), r * float(y))
                for x, y in ((c, s), (-s, c), (-c, -s), (s, -c))
            )
            carried = east + west >= north + south
            centre: Single = half * np.maximum(east + west, north + south)
            # The diagonal that carries has its own slope; one pad of the other touches down.
            own: Single = half * inverse * np.where(carried, east - west, north - south)
            ahead: Single = (np.where(carried, north, east) - centre) * inverse
            behind: Single = (centre - np.where(carried, south, west)) * inverse
            for other in (ahead, behind):
                along: Single = np.where(carried, own, other)
                across: Single = np.where(carried, other, own)
                yield centre, along * c - across * s, along * s + across * c


class _Roof:
    """A plane over all ground that the lander can meet at the nodes of a block.

    For each block of ``BLOCK`` by ``BLOCK`` nodes: the node plane at the block's centre, raised
    to lie above every cell top within the lander's radius of any node of the block. A resting
    plane then leaves at most roof - rest at the node, plus the radius times the difference of the
    slopes, above itself.
    """

    def __init__(self, ground: _Ground, planes: NodePlanes, rows: slice, columns: slice) -> None:
        self.radius = np.float32(ground.radius)
        row = np.arange(rows.start, rows.stop, BLOCK)
        column = np.arange(columns.start, columns.stop, BLOCK)
        middle = BLOCK // 2
        last = len(planes.elevation) - 1
        at = np.ix_(np.minimum(row + middle, last), np.minimum(column + middle, last))
        gx, gy = planes.slope_x[at].astype(np.float32), planes.slope_y[at].astype(np.float32)
        over = disc(ground.radius + ground.side * np.hypot(middle, middle), ground.side)
        highest = np.full(gx.shape, -np.inf, dtype=np.float32)
        work = np.empty_like(highest)
        for up, right, x, y in zip(
            over.row.tolist(), over.column.tolist(), over.x.tolist(), over.y.tolist(), strict=True
        ):
            r, c = rows.start + middle + up, columns.start + middle + right
            top = ground.top[r + ground.border :: BLOCK, c + ground.border :: BLOCK]
            np.multiply(gx, np.float32(-x), out=work)
            work -= gy * np.float32(y)
            work += top[: gx.shape[0], : gx.shape[1]]
            np.maximum(highest, work, out=highest)
        shape = (rows.stop - rows.start, columns.stop - columns.start)
        self.slope_x, self.slope_y = _spread(gx, shape), _spread(gy, shape)
        x = ((np.arange(shape[1]) % BLOCK - middle) * ground.side).astype(np.float32)
        y = ((np.arange(shape[0]) % BLOCK - middle) * ground.side).astype(np.float32)
        self.height = _spread(highest, shape) + self.slope_x * x + self.slope_y * y[:, None]

    def above(self, centre: Single, slope_x: Single, slope_y: Single) -> Single:
        """Bound on how high the ground rises above resting planes, per node of the window."""
        dx, dy = self.slope_x - slope_x, self.slope_y - slope_y
        apart: Single = np.sqrt(dx * dx + dy * dy)
        apart *= self.radius
        apart += self.height
        apart -= centre
        return apart


def _spread(blocks: Single, shape: tuple[int, int]) -> Single:
    """Values of blocks at each of their nodes."""
    return blocks.repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)[: shape[0], : shape[1]]


def _compare(
    ground: _Ground,
    over: Disc,
    rows: slice,
    columns: slice,
    failed: Mask,
    doubts: list[tuple[Index, Single]],
    limit: np.float32,
) -> None:
    """Settle doubtful (node, plane) pairs on the cells of the disc; sets ``failed``.

    The cell that stands highest over the mean of a node's doubtful planes mostly decides: where it
    is too high the node fails, where its height plus the planes' distance is not, the plane is
    cleared. What is left is compared with every cell.
    """
    if not doubts:
        return
    flat = failed.ravel()
    width = columns.stop - columns.start
    of_pair = np.concatenate([node for node, _ in doubts])
    plane = np.concatenate([values for _, values in doubts], axis=1)
    open_ = np.flatnonzero(~flat[of_pair])
    open_ = open_[np.argsort(of_pair[open_], kind="stable")]
    of_pair, plane = of_pair[open_], plane[:, open_]
    nodes, first = np.unique(of_pair, return_index=True)
    first = np.append(first, len(of_pair))
    x_of, y_of = over.x.astype(np.float32), over.y.astype(np.float32)
    stride = ground.top.shape[1]
    offset = over.row * stride + over.column
    for begin in range(0, len(nodes), NODES):
        chunk = nodes[begin : begin + NODES]
        pairs = slice(first[begin], first[min(begin + NODES, len(nodes))])
        planes, place = plane[:, pairs], of_pair[pairs]
        local = np.searchsorted(chunk, place)
        row, column = chunk // width + rows.start, chunk % width + columns.start
        corner = (row + ground.border) * stride + column + ground.border
        tops = ground.top.ravel()[corner[:, None] + offset]
        count = np.bincount(local, minlength=len(chunk))
        mean = np.stack([np.bincount(local, part) / count for part in planes]).astype(np.float32)
        over_mean = _above(tops, mean, x_of, y_of)
        best = np.argmax(over_mean, axis=1)
        each = np.arange(len(chunk))
        worst, high = over_mean[each, best], tops[each, best][local]
        x, y = x_of[best][local], y_of[best][local]
        flat[place[high - planes[0] - planes[1] * x - planes[2] * y > limit]] = True
        apart = mean[:, local] - planes
        bound = worst[local] + apart[0] + np.float32(ground.radius) * np.hypot(apart[1], apart[2])
        left = np.flatnonzero((bound > limit - ROUNDING) & ~flat[place])
        for part in range(0, len(left), NODES):
            pick = left[part : part + NODES]
            above = _above(tops[local[pick]], planes[:, pick], x_of, y_of)
            flat[place[pick[above.max(axis=1) > limit]]] = True


def _above(tops: Single, plane: Single, x: Single, y: Single) -> Single:
    """Heights (K, C) of cells over planes (3, K); x, y (C,) of the cells from the node, m."""
    out: Single = plane[1][:, None] * x
    out += plane[2][:, None] * y
    np.subtract(tops, out, out=out)
    out -= plane[0][:, None]
    return out
