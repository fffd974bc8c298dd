# SPDX-License-Identifier: Apache-2.0
"""A square that follows, in nodes: the vehicle as offline, and the landing area."""

import pytest
from geometry_msgs.msg import PolygonStamped
from replay.recordings import write_ros2
from ros_scene import Sensors
from ros_vehicle import polygon

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.lab.live.demo import run_live
from quadtree_lss.onboard.messages.maps import encode_cells
from quadtree_lss.onboard.nodes.qos import stream

pytestmark = pytest.mark.xdist_group("ros_faults")


@pytest.mark.slow
def test_the_nodes_follow_the_vehicle_as_a_replay_does(ros):
    params = ros.params.read_text().replace("max_level: 6", "max_level: 6, follow: vehicle")
    ros.params.write_text(params)
    bag = write_ros2(ros.folder / "bag", scans=60)
    offline = replay(bag, None, load_config([str(ros.params)]), report=False)
    assert offline.cells.domain.xmin > 0.0, "24 m on its way"
    live = run_live(bag, ros.params, offline.timings[-1].stamp_ns, ros.folder / "live")
    assert live.cells.domain == offline.cells.domain
    assert encode_cells(live.cells).tobytes() == encode_cells(offline.cells).tobytes()


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
