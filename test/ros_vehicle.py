# SPDX-License-Identifier: Apache-2.0
"""A vehicle for the tests of lss_node: its topics, and everything that lss_node publishes."""

import dataclasses

import numpy as np
from geometry_msgs.msg import PolygonInstanceStamped, PolygonStamped, PoseArray
from nav_msgs.msg import OccupancyGrid
from ros_scene import MAKE, START_NS, map_messages
from sensor_msgs.msg import PointCloud2

from quadtree_lss.onboard.messages.clouds import stamp_ns
from quadtree_lss.onboard.nodes.qos import latched


def polygon(corners, frame="map", number=None):
    """Of a set, with a number."""
    message = MAKE.polygon(1, corners, number)
    message.header.frame_id = frame
    return message


def point(x, y):
    return MAKE.point(1, (x, y, 0.0))


class Vehicle:
    """Publishers of lss_node's inputs, latched, and a record of its sites by stamp."""

    def __init__(self, listener, cells):
        node = listener.node
        self.listener, self.cells = listener, cells
        self._publishers = {
            topic: node.create_publisher(kind, topic, latched())
            for topic, kind in (
                ("map/cells", PointCloud2),
                ("map/observed", OccupancyGrid),
                ("landing/area", PolygonStamped),
                ("landing/keep_out", PolygonStamped),
            )
        }
        self._publishers["landing/keep_outs"] = node.create_publisher(
            PolygonInstanceStamped, "landing/keep_outs", latched(5)
        )
        self.said = []
        node.create_subscription(PoseArray, "landing/sites", self._on_sites, latched())

    def _on_sites(self, message):
        places = np.array([(p.position.x, p.position.y) for p in message.poses]).reshape(-1, 2)
        self.said.append((stamp_ns(message.header), message.header.frame_id, places))

    def send_map(self, seconds, frame="map", observed_frame=None):
        """Publish the map with a stamp ``seconds`` after the start; return the stamp."""
        stamp = START_NS + seconds * 10**9
        cells = dataclasses.replace(self.cells, stamp_ns=stamp)
        self.send("map/observed", map_messages(cells, observed_frame or frame)[1])
        self.send("map/cells", map_messages(cells, frame)[0])
        return stamp

    def until(self, condition, *args, **how):
        """As the listener's."""
        self.listener.until(condition, *args, **how)

    def send(self, topic, message):
        self._publishers[topic].publish(message)

    def last(self):
        return self.said[-1] if self.said else (None, None, None)

    def sites_of(self, stamp, condition):
        """Return whether the last sites are those of this map and fulfil all conditions."""
        last, _, places = self.last()
        return last == stamp and len(places) > 0 and bool(np.all(condition(places)))

    def none_of(self, stamp):
        """Return whether the last message has the map's stamp and no site."""
        last, _, places = self.last()
        return last == stamp and len(places) == 0

    def has(self, key, value):
        """Return whether a diagnostic value equals ``value``."""
        return self.values().get(key) == str(value)

    def values(self):
        return self.listener.values("lss_node")

    def told(self, level, *words):
        """Return whether the last status has this level and all these words."""
        return self.listener.told("lss_node", (level,), *words)
