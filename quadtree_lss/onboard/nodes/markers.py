# SPDX-License-Identifier: Apache-2.0
"""Map and sites as markers for viewers such as RViz."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import Point, Vector3
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from quadtree_lss.onboard.arrays import Array, Index
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.messages.maps import site_orientations
from quadtree_lss.onboard.nodes.executor import steady_timer
from quadtree_lss.onboard.nodes.ros_messages import header_message

if TYPE_CHECKING:  # slow to import, and not needed by mapping_node
    from quadtree_lss.onboard.core.landing.result import LandingAssessment


class CdrWriter:
    """Writer of little-endian CDR (version 1), which aligns each number to its size."""

    def __init__(self) -> None:
        self._parts: list[bytes] = [b"\x00\x01\x00\x00"]
        self._size = 0

    def numbers(self, code: str, *values: float) -> CdrWriter:
        """Append numbers of one ``struct`` code, such as ``I`` or ``d``."""
        self._align(struct.calcsize(f"<{code}"))
        return self._append(struct.pack(f"<{len(values)}{code}", *values))

    def string(self, text: str) -> CdrWriter:
        """Append a string with its length and final zero."""
        content = text.encode() + b"\x00"
        return self.numbers("I", len(content))._append(content)

    def rows(self, values: NDArray[Any], code: str) -> CdrWriter:
        """Append a sequence of N messages of k equal numbers (N, k)."""
        self.numbers("I", len(values))
        if len(values):
            self._align(struct.calcsize(f"<{code}"))
            self._append(np.ascontiguousarray(values, dtype=f"<{code}").tobytes())
        return self

    def message(self) -> bytes:
        """Return the serialised message."""
        return b"".join(self._parts)

    def _align(self, size: int) -> None:
        self._append(b"\x00" * (-self._size % size))

    def _append(self, content: bytes) -> CdrWriter:
        self._parts.append(content)
        self._size += len(content)
        return self


LOW_TO_HIGH = np.array(
    [
        [0.27, 0.00, 0.33],
        [0.23, 0.32, 0.55],
        [0.13, 0.57, 0.55],
        [0.37, 0.79, 0.38],
        [0.99, 0.91, 0.14],
    ]
)
"""Colours of elevations, evenly spaced."""

CORNERS = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
"""Two triangles of a unit square, counter-clockwise."""

VIEWER_PERIOD_S = 1.0
CIRCLE_POINTS = 48
FIRST_COLOUR = ColorRGBA(r=0.1, g=0.9, b=0.2, a=1.0)
OTHER_COLOUR = ColorRGBA(r=0.2, g=0.6, b=1.0, a=1.0)


class MarkerPublisher:
    """Publish messages for viewers on a slow timer, if they changed or a subscriber joined.
    ``build`` returns the message or its bytes."""

    def __init__(
        self, node: Node, publisher: Publisher, build: Callable[[], MarkerArray | bytes | None]
    ) -> None:
        self._publisher = publisher
        self._build = build
        self._changed = False
        self._subscribers = 0
        steady_timer(node, VIEWER_PERIOD_S, self._send)

    def changed(self) -> None:
        """Note a change."""
        self._changed = True

    def delete_all(self, header: Header) -> None:
        """Delete all markers immediately, also for late subscribers."""
        deletion = Marker(header=header, action=Marker.DELETEALL)
        self._publisher.publish(MarkerArray(markers=[deletion]))
        self._changed = False

    def _send(self) -> None:
        subscribers = self._publisher.get_subscription_count()
        joined, self._subscribers = subscribers > self._subscribers, subscribers
        if not subscribers or not (self._changed or joined):
            return
        self._changed = False
        message = self._build()
        if message is not None:
            self._publisher.publish(message)


def cell_markers(cells: CellMap, frame: str) -> bytes:
    """Serialise ``map/markers``: one marker per level, with two triangles per plane."""
    leaves = np.flatnonzero(cells.estimated)
    colour = elevation_colours(cells.heights(leaves, cells.x[leaves], cells.y[leaves]))
    writer = CdrWriter()
    levels = range(cells.domain.min_level, cells.domain.max_level + 1)
    writer.numbers("I", len(levels))
    seconds, nanoseconds = divmod(cells.stamp_ns, 1_000_000_000)
    for level in levels:
        chosen = np.flatnonzero(cells.level[leaves] == level)
        vertices = patch_vertices(cells, leaves[chosen]).reshape(-1, 3)
        colours = np.repeat(colour[chosen], len(CORNERS), axis=0)
        action = Marker.ADD if len(chosen) else Marker.DELETE
        writer.numbers("i", seconds).numbers("I", nanoseconds).string(frame)
        writer.string("cells").numbers("i", level, Marker.TRIANGLE_LIST, action)
        writer.numbers("d", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)  # pose
        writer.numbers("d", 1.0, 1.0, 1.0)  # scale
        writer.numbers("f", 1.0, 1.0, 1.0, 1.0)  # colour; unused with colours of vertices
        writer.numbers("i", 0).numbers("I", 0)  # lifetime
        writer.numbers("?", False)  # frame_locked
        writer.rows(vertices, "d").rows(colours, "f")
        writer.string("")  # texture_resource
        writer.numbers("i", 0).numbers("I", 0).string("").string("").numbers("I", 0)  # texture
        writer.numbers("I", 0)  # uv_coordinates
        writer.string("").string("")  # text, mesh_resource
        writer.string("").numbers("I", 0)  # mesh_file
        writer.numbers("?", False)  # mesh_use_embedded_materials
    return writer.message()


def patch_vertices(cells: CellMap, rows: Index) -> Array:
    """Return the corners (K, 6, 3) of two triangles on the plane of each leaf in ``rows``, map
    frame, m; heights are limited to the range of the leaf's points."""
    offset = CORNERS * cells.size[rows, None, None]
    out = np.empty((len(rows), len(CORNERS), 3))
    out[..., 0] = cells.x[rows, None] + offset[..., 0]
    out[..., 1] = cells.y[rows, None] + offset[..., 1]
    out[..., 2] = cells.heights(rows[:, None], out[..., 0], out[..., 1])
    return out


def elevation_colours(z: Array) -> Array:
    """Return opaque colours (K, 4) of elevations (K,), scaled from their 2nd to 98th percentile."""
    out = np.ones((len(z), 4))
    if len(z):
        low, high = np.percentile(z, [2.0, 98.0])
        fraction = np.clip((z - low) / max(high - low, 1e-6), 0.0, 1.0)
        steps = np.linspace(0.0, 1.0, len(LOW_TO_HIGH))
        for channel in range(3):
            out[:, channel] = np.interp(fraction, steps, LOW_TO_HIGH[:, channel])
    return out


def site_markers(assessment: LandingAssessment, frame: str, zone_radius: float) -> MarkerArray:
    """Make ``landing/markers``: circle of the zone, normal and rank of each site."""
    header = header_message(assessment.stamp_ns, frame)
    sites = assessment.sites
    markers = [Marker(header=header, action=Marker.DELETEALL)]
    angle = np.linspace(0.0, 2.0 * math.pi, CIRCLE_POINTS + 1)
    orientations = site_orientations(sites.normal)
    for k, (position, normal) in enumerate(zip(sites.position, sites.normal, strict=True)):
        colour = FIRST_COLOUR if k == 0 else OTHER_COLOUR
        flat = zone_radius * np.column_stack([np.cos(angle), np.sin(angle)])
        circle = np.column_stack([flat, -(flat @ normal[:2]) / normal[2]]) + position
        markers.append(_marker(header, "zone", k, Marker.LINE_STRIP, 0.08, colour))
        markers[-1].points = _points(circle)
        markers.append(_marker(header, "normal", k, Marker.ARROW, 0.12, colour))
        markers[-1].scale = Vector3(x=0.12, y=0.3, z=0.4)
        markers[-1].points = _points(np.stack([position, position + 2.0 * normal]))
        markers.append(_marker(header, "rank", k, Marker.TEXT_VIEW_FACING, 1.5, colour))
        markers[-1].text = f"{k + 1}"
        pose, q = markers[-1].pose, orientations[k].tolist()
        pose.position = _points((position + 2.8 * normal)[None])[0]
        pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = q
    return MarkerArray(markers=markers)


def _marker(
    header: Header, name: str, number: int, kind: int, size: float, colour: ColorRGBA
) -> Marker:
    marker = Marker(header=header, ns=name, id=number, type=kind, action=Marker.ADD, color=colour)
    marker.scale = Vector3(x=size, y=size, z=size)
    marker.pose.orientation.w = 1.0
    return marker


def _points(values: Array) -> list[Point]:
    return [Point(x=x, y=y, z=z) for x, y, z in values.tolist()]
