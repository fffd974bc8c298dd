# SPDX-License-Identifier: Apache-2.0
"""A square that follows the landing area, in mapping_node."""

import pytest
from geometry_msgs.msg import PolygonStamped
from ros_vehicle import polygon

from quadtree_lss.onboard.nodes.qos import stream

pytestmark = pytest.mark.xdist_group("ros_faults")


def test_mapping_node_follows_the_landing_area(ros):
    ros.start("mapping_node", "-p", "domain.follow:=area")
    with ros.sensors() as (listener, sensors):
        sensors.map(2)
        assert listener.newest["map/observed"].info.origin.position.x == -16.0
        profile = stream(1, reliable=True)
        say = listener.node.create_publisher(PolygonStamped, "landing/area", profile)
        listener.until(say.get_subscription_count)
        area, later = polygon([(4.0, -3.0), (12.0, -3.0), (12.0, 3.0)]), [0]

        def moved():
            say.publish(area)
            later[0] += 10**10
            sensors.publish(1, offset_ns=later[0])
            return listener.newest["map/observed"].info.origin.position.x == -8.0

        listener.until(moved)
        assert listener.newest["map/observed"].info.origin.position.y == -16.0
