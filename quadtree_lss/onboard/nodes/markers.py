# SPDX-License-Identifier: Apache-2.0
"""Map and sites as markers for viewers such as RViz."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from geometry_msgs.msg import Point, Vector3
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from quadtree_lss.onboard.arrays import Array, Index
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.messages.maps import site_orientations
from quadtree_lss.onboard.nodes.qos import steady_timer
from quadtree_lss.onboard.nodes.ros_messages import header_message

if TYPE_CHECKING:  # slow to import, and not needed by mapping_node
    from quadtree_lss.onboard.core.landing.result import LandingAssessment


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

SIZE_AFTER_POINTS = 73
"""Bytes of a serialised marker after its points: no colours, texture, text and mesh."""
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
        self.changed = False
        self._publisher, self._build = publisher, build
        self._subscribers = 0
        steady_timer(node, VIEWER_PERIOD_S, self._send)

    def delete_all(self, header: Header) -> None:
        """Delete all markers immediately, also for late subscribers."""
        deletion = Marker(header=header, action=Marker.DELETEALL)
        self._publisher.publish(MarkerArray(markers=[deletion]))
        self.changed = False

    def _send(self) -> None:
        subscribers = self._publisher.get_subscription_count()
        joined, self._subscribers = subscribers > self._subscribers, subscribers
        if subscribers and (self.changed or joined):
            self.changed = False
            message = self._build()
            if message is not None:
                self._publisher.publish(message)


def cell_markers(cells: CellMap, frame: str) -> bytes:
    """Serialise ``map/markers``: two triangles per plane.

    The arrays are inserted into a serialised message without points, because rclpy needs seconds to
    convert as many points of a large map.
    """
    leaves = np.flatnonzero(cells.estimated)
    header = header_message(cells.stamp_ns, frame)
    marker = _marker(header, "cells", 0, Marker.TRIANGLE_LIST, 1.0, FIRST_COLOUR)
    if not len(leaves):
        marker.action = Marker.DELETE
    raw: bytes = serialize_message(MarkerArray(markers=[marker]))
    if not len(leaves):
        return raw
    colours = elevation_colours(cells.heights(leaves, cells.x[leaves], cells.y[leaves]))
    colours = np.repeat(colours, len(CORNERS), axis=0)
    count, head = struct.pack("<I", len(colours)), raw[: -SIZE_AFTER_POINTS - 4]
    alignment = bytes(-len(head) % 8)  # of the first double
    points = patch_vertices(cells, leaves).astype("<f8").tobytes()
    tail = raw[len(head) + 8 :]
    return b"".join((head, count, alignment, points, count, colours.astype("<f4").tobytes(), tail))


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
    low, high = np.percentile(z, [2.0, 98.0])
    steps = np.linspace(low, max(high, low + 1e-6), len(LOW_TO_HIGH))
    channels = [np.interp(z, steps, channel) for channel in LOW_TO_HIGH.T]
    return np.stack([*channels, np.ones(len(z))], axis=-1)


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
