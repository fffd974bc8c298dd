# SPDX-License-Identifier: Apache-2.0
"""Markers: what the serialised ones contain, and when they are sent."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml
from rclpy.serialization import deserialize_message, serialize_message
from ros_scene import mapped
from visualization_msgs.msg import Marker, MarkerArray

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.lab.live.listener import TOPICS
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.messages.maps import round_trip
from quadtree_lss.onboard.nodes.markers import cell_markers, site_markers

pytestmark = pytest.mark.xdist_group("ros_markers")

MARKERS = {"map/markers": MarkerArray, "landing/markers": MarkerArray}


@pytest.fixture(scope="module")
def mapper():
    """A mapper after two scans."""
    return mapped(load_config(["morpheus"]), 2)


def test_serialised_markers_are_what_rclpy_would_send(mapper):
    content = cell_markers(mapper.snapshot(), "map")
    message = deserialize_message(content, MarkerArray)
    again = serialize_message(message)
    assert len(again) == len(content) and deserialize_message(again, MarkerArray) == message
    last = message.markers[-1]
    assert last.header.frame_id == "map" and last.ns == "cells"
    assert (last.pose.orientation.w, last.scale.x, last.color.a) == (1.0, 1.0, 1.0)
    assert last.text == last.mesh_resource == last.texture_resource == ""


def test_one_marker_per_level_covers_each_plane_with_two_triangles(mapper):
    cells = mapper.snapshot()
    free = np.full_like(cells.low, np.nan)
    cells = dataclasses.replace(cells, low=free, high=free)
    message = deserialize_message(cell_markers(cells, "map"), MarkerArray)
    levels = range(cells.domain.min_level, cells.domain.max_level + 1)
    assert [marker.id for marker in message.markers] == list(levels)
    for marker in message.markers:
        rows = np.flatnonzero(cells.estimated & (cells.level == marker.id))
        assert marker.action == (Marker.ADD if len(rows) else Marker.DELETE)
        assert marker.type == Marker.TRIANGLE_LIST
        assert len(marker.points) == len(marker.colors) == 6 * len(rows)
        if not len(rows):
            continue
        corners = np.array([(p.x, p.y, p.z) for p in marker.points]).reshape(len(rows), 2, 3, 3)
        edge = np.diff(corners, axis=2)
        normal = 0.5 * np.cross(edge[:, :, 0], edge[:, :, 1])
        area = cells.size[rows] ** 2 / cells.normal[rows, 2]
        np.testing.assert_allclose(normal.sum(axis=1), cells.normal[rows] * area[:, None])
        centre = corners.min(axis=(1, 2)) + corners.max(axis=(1, 2))
        middle = np.column_stack([cells.x[rows], cells.y[rows], cells.z[rows]])
        np.testing.assert_allclose(0.5 * centre, middle)


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


def test_markers_come_to_whom_subscribes_late_and_go_with_a_reset(ros):
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


def test_rviz_configuration_names_existing_topics():
    path = Path(__file__).parents[2] / "rviz" / "quadtree_lss.rviz"
    displays = yaml.safe_load(path.read_text())["Visualization Manager"]["Displays"]
    shown = {d["Topic"]["Value"] for d in displays if "Topic" in d}
    known = {f"/{name}" for name in (*TOPICS, *MARKERS)}
    assert shown <= known
    wanted = {"/map/markers", "/landing/hazards", "/landing/score", "/landing/markers"}
    assert wanted <= shown
    for display in displays:
        if "Topic" in display:
            policy = display["Topic"]
            assert policy["Durability Policy"] == "Transient Local"
            assert policy["Reliability Policy"] == "Reliable"
