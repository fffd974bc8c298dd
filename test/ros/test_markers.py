# SPDX-License-Identifier: Apache-2.0
"""Markers: content of the serialised messages, and times of publication."""

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from ros_scene import mapped
from visualization_msgs.msg import Marker, MarkerArray

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.messages.maps import round_trip
from quadtree_lss.onboard.nodes.markers import cell_markers, patch_vertices, site_markers

pytestmark = pytest.mark.xdist_group("ros_markers")

MARKERS = {"map/markers": MarkerArray, "landing/markers": MarkerArray}


@pytest.fixture(scope="module")
def mapper():
    """A mapper after two scans."""
    return mapped(load_config(["morpheus"]), 2)


@pytest.mark.parametrize("frame", ["", "map", "local_map"])
def test_cells_have_two_triangles_per_plane(mapper, frame):
    cells = mapper.snapshot()
    (marker,) = deserialize_message(cell_markers(cells, frame), MarkerArray).markers
    leaves = np.flatnonzero(cells.estimated)
    points = [(point.x, point.y, point.z) for point in marker.points]
    np.testing.assert_array_equal(points, patch_vertices(cells, leaves).reshape(-1, 3))
    assert len(marker.colors) == len(points) and {colour.a for colour in marker.colors} == {1.0}
    assert (marker.header.frame_id, marker.ns) == (frame, "cells") and not marker.mesh_resource


def test_sites_have_circle_normal_and_rank(mapper):
    config = load_config(["morpheus"], {"lss.max_risk": 0.2})  # few returns
    result = LandingSiteSelector(config).assess(round_trip(mapper.snapshot()))
    message = site_markers(result, "map", 1.85)
    assert message.markers[0].action == Marker.DELETEALL
    count = len(result.sites.score)
    assert count and len(message.markers) == 1 + 3 * count
    by_name = {(m.ns, m.id): m for m in message.markers}
    for k in range(count):
        assert by_name["rank", k].text == str(k + 1)
        circle = np.array([(p.x, p.y, p.z) for p in by_name["zone", k].points])
        arm = circle - result.sites.position[k]
        np.testing.assert_allclose(np.hypot(arm[:, 0], arm[:, 1]), 1.85)
        np.testing.assert_allclose(arm @ result.sites.normal[k], 0.0, atol=1e-9)


@pytest.mark.slow
def test_markers_reach_late_subscribers_and_are_deleted_by_a_reset(ros):
    ros.start("mapping_node"), ros.start("lss_node")
    with ros.sensors() as (listener, sensors):
        last = sensors.publish(4)
        listener.until_stamped(last, "landing/sites")
        with ros.listen(MARKERS) as viewer:
            viewer.until(lambda: len(viewer.newest) == 2)
            cells = viewer.newest["map/markers"].markers
            assert sum(len(marker.points) for marker in cells) > 0
            assert {m.ns for m in viewer.newest["landing/markers"].markers} >= {"zone", "rank"}
            assert ros.call(listener, "/mapping_node/reset").success
            viewer.until(_deleted, viewer, "map/markers")
            viewer.until(_deleted, viewer, "landing/markers")


def _deleted(viewer, topic):
    return [marker.action for marker in viewer.newest[topic].markers] == [Marker.DELETEALL]
