# SPDX-License-Identifier: Apache-2.0
"""A square that follows the landing area, in mapping_node."""

import pytest
from geometry_msgs.msg import PolygonStamped
from ros_scene import Sensors
from ros_vehicle import polygon

from quadtree_lss.onboard.nodes.qos import stream

pytestmark = pytest.mark.xdist_group("ros_faults")


def test_mapping_node_follows_the_landing_area(ros):
    mapping = ros.start("mapping_node", "-p", "domain.follow:=area")
    with ros.listen() as listener:
        sensors = Sensors(listener).matched()
        sensors.map(mapping, 2)
        assert listener.newest["map/observed"].info.origin.position.x == -16.0
        say = listener.node.create_publisher(
            PolygonStamped, "landing/area", stream(1, reliable=True)
        )
        assert listener.wait_for(lambda: say.get_subscription_count() == 1), mapping.output()
        area, later = polygon([(4.0, -3.0), (12.0, -3.0), (12.0, 3.0)]), [0]

        def moved():
            say.publish(area)
            later[0] += 10**10
            sensors.publish(1, offset_ns=later[0])
            return listener.newest["map/observed"].info.origin.position.x == -8.0

        assert listener.wait_for(moved), mapping.output()
        assert listener.newest["map/observed"].info.origin.position.y == -16.0
