# SPDX-License-Identifier: Apache-2.0
"""No site inside a keep-out or outside an area that lss_node was told or could have read."""

import dataclasses
import signal

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from ros_scene import MAKE
from ros_vehicle import Vehicle, point, polygon
from sensor_msgs.msg import PointCloud2

from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.landing_inputs import (
    MAX_VERTICES,
    dispersion_from_message,
    polygon_from_message,
    target_from_message,
)
from quadtree_lss.onboard.messages.maps import SITE_FIELDS
from quadtree_lss.onboard.messages.outputs import cloud_records
from quadtree_lss.onboard.nodes.landing_topics import JOIN_S, UNHEARD_S
from quadtree_lss.onboard.nodes.qos import latched
from quadtree_lss.onboard.nodes.ros_messages import map_messages

pytestmark = pytest.mark.xdist_group("ros_landing")

EVERYWHERE = [(-16, -16), (16, -16), (16, 16), (-16, 16)]
WEST = [(-16, -16), (5, -16), (5, 16), (-16, 16)]
PATIENT = ("-p", "diagnostics.warn_age:=60.0")
"""A map counts as fresh in every status: one a second is as seldom as the default warns."""


def dispersion(var_x, var_y, heading=0.0, heading_variance=0.0):
    turn = (0.0, 0.0, np.sin(0.5 * heading), np.cos(0.5 * heading))
    covariance = np.diag([var_x, var_y, 0.0, 0.0, 0.0, heading_variance])
    return MAKE.pose(1, np.zeros(3), turn, covariance)


@pytest.fixture
def vehicle(ros, cells):
    with ros.listen({}) as listener:
        yield Vehicle(listener, cells)


def anywhere(places):
    return np.isfinite(places[:, 0])


def east(places):
    return places[:, 0] >= 5.0


def test_a_restarted_node_waits_for_the_latched_keep_out(ros, vehicle):
    vehicle.send("landing/keep_out", polygon(WEST))
    stamp = vehicle.send_map(0)
    for _ in range(2):  # first without an area, for which it waits in vain, then with both
        lss = ros.start("lss_node")
        vehicle.until(vehicle.sites_of, stamp, anywhere)
        assert all(east(places).all() for _, _, places in vehicle.said), vehicle.said
        lss.stop(signal.SIGKILL)
        vehicle.said.clear()
        vehicle.send("landing/area", polygon([]))


def test_a_restarted_node_has_all_keep_outs_of_the_latched_set(ros, vehicle):
    """West, then the east but for its north; the west comes again, smaller, and is removed."""
    south = [(4, -16), (16, -16), (16, 0), (4, 0)]
    for number, corners in ((1, WEST), (2, south), (3, WEST), (3, [])):
        vehicle.send("landing/keep_outs", polygon(corners, number=number))
    stamp = vehicle.send_map(0)
    for _ in range(2):
        lss = ros.start("lss_node")
        vehicle.until(vehicle.sites_of, stamp, anywhere)
        said = [places for _, _, places in vehicle.said]
        assert all(east(places).all() and (places[:, 1] > 0.0).all() for places in said), said
        lss.stop(signal.SIGKILL)
        vehicle.said.clear()


def test_a_required_input_is_waited_for(ros, vehicle):
    """However late it comes: longer than any wait for what may come."""
    ros.start("lss_node", "-p", "lss.required_input:=keep_out")
    stamp = vehicle.send_map(0)
    vehicle.until(vehicle.told, DiagnosticStatus.WARN, "waiting for", "landing/keep_out")
    assert not vehicle.listener.wait_for(lambda: vehicle.said, timeout=JOIN_S + UNHEARD_S + 1.0)
    vehicle.send("landing/keep_out", polygon(WEST))
    vehicle.until(vehicle.sites_of, stamp, anywhere)
    assert all(east(places).all() for _, _, places in vehicle.said), vehicle.said


def test_a_keep_out_counts_in_the_frame_of_the_map_whenever_it_came(ros, vehicle):
    vehicle.send("landing/keep_out", polygon(WEST, "moon"))
    ros.start("lss_node", *PATIENT)
    vehicle.until(vehicle.has, "landing.keep_out", True)
    stamp = vehicle.send_map(1, "moon")
    vehicle.until(vehicle.sites_of, stamp, anywhere)
    assert vehicle.last()[1] == "moon"

    stamp = vehicle.send_map(2, "map")
    vehicle.until(vehicle.none_of, stamp)
    words = ("no site is given out", "landing/keep_out", "'moon'", "'map'")
    vehicle.until(vehicle.told, DiagnosticStatus.ERROR, *words)
    assert vehicle.values()["landing.keep_out"] == "unusable"
    assert vehicle.values()["problems.keep_out_frame"] == "1", "it came by two ways, but once"

    stamp = vehicle.send_map(3, "moon")
    vehicle.until(vehicle.sites_of, stamp, anywhere)
    assert all(east(places).all() for _, _, places in vehicle.said), vehicle.said
    vehicle.until(vehicle.told, DiagnosticStatus.OK, "sites")


def test_no_site_while_the_last_polygon_cannot_be_used(ros, vehicle):
    ros.start("lss_node")
    stamp = vehicle.send_map(0)
    vehicle.until(vehicle.sites_of, stamp, anywhere)
    bad = (
        ("landing/area", polygon(EVERYWHERE[:2]), "area_polygon"),
        ("landing/keep_out", polygon(EVERYWHERE, "odom"), "keep_out_frame"),
        ("landing/keep_out", polygon([(0, 0), (1, float("nan")), (2, 2)]), "keep_out_polygon"),
        ("landing/area", polygon([(-3e38, -3e38), (3e38, -3e38), (0, 3e38)]), "area_polygon"),
    )
    counts = {}
    for topic, message, problem in bad:
        vehicle.send(topic, message)
        vehicle.until(vehicle.none_of, stamp)
        counts[problem] = counts.get(problem, 0) + 1
        vehicle.until(vehicle.has, f"problems.{problem}", counts[problem])
        vehicle.until(vehicle.told, DiagnosticStatus.ERROR, topic)
        vehicle.send(topic, polygon([]))
        vehicle.until(vehicle.sites_of, stamp, anywhere)
    found = {k: v for k, v in vehicle.values().items() if k.startswith("problems.")}
    assert found == {f"problems.{key}": str(n) for key, n in counts.items()}


def test_halves_of_two_maps_are_not_joined(ros, vehicle):
    """Neither those of one stamp that belong to two maps, nor those of two frames."""
    ros.start("lss_node", "-p", "publish.lss_rate:=50.0")
    stamp = vehicle.send_map(0)
    vehicle.until(vehicle.sites_of, stamp, anywhere)
    received, said = int(vehicle.values().get("map.received", 1)), len(vehicle.said)
    nothing = np.zeros_like(vehicle.cells.observed)
    other = dataclasses.replace(vehicle.cells, stamp_ns=stamp, observed=nothing)
    vehicle.send("map/observed", map_messages(other, "map")[1])
    stamp = vehicle.send_map(0, "odom", observed_frame="map")
    vehicle.until(vehicle.has, "problems.map.frame", 1)
    values = vehicle.values()
    assert values["map.refused"] == "1" and int(values["map.received"]) == received
    assert all(len(places) for _, _, places in vehicle.said[said:]), "of a map without ground"
    stamp = vehicle.send_map(1)
    vehicle.until(vehicle.sites_of, stamp, anywhere)
    assert {frame for _, frame, _ in vehicle.said} == {"map"}


def test_polygons_and_targets():
    np.testing.assert_array_equal(polygon_from_message(polygon(WEST), "/map"), WEST)
    assert polygon_from_message(polygon([]), "map") is None
    np.testing.assert_array_equal(target_from_message(point(1.0, 2.0), "map"), (1.0, 2.0))
    assert target_from_message(point(float("nan"), float("nan")), "map") is None
    many = [(np.cos(a), np.sin(a)) for a in np.linspace(0.0, 6.0, MAX_VERTICES + 1)]
    for corners, frame, reason in (
        (WEST, "odom", "frame"),
        ([], "odom", "frame"),
        (WEST[:2], "map", "polygon"),
        (many, "map", "polygon"),
        ([(0, 0), (1, float("inf")), (1, 1)], "map", "polygon"),
        ([(0, 0), (1e13, 0), (1, 1)], "map", "polygon"),
    ):
        with pytest.raises(MessageError) as caught:
            polygon_from_message(polygon(corners, frame), "map")
        assert caught.value.reason == reason
    for x, y in ((float("nan"), 0.0), (float("inf"), 0.0), (0.0, 1e300)):
        with pytest.raises(MessageError) as caught:
            target_from_message(point(x, y), "map")
        assert caught.value.reason == "point"


def test_a_dispersion_has_deviations_and_a_heading_that_is_known_or_any():
    found = dispersion_from_message(dispersion(4.0, 0.25, 0.7, 0.01), "map")
    np.testing.assert_allclose(found, (2.0, 0.5, 0.7))
    found = dispersion_from_message(dispersion(0.0, 1.0, 0.7, 1.0), "map")
    np.testing.assert_array_equal(found, (0.0, 1.0))
    assert dispersion_from_message(dispersion(np.nan, np.nan), "map") is None
    for length, heading in ((2.0, [0.7]), (0.1, [0.7]), (0.0, [])):
        said = dispersion(1.0, 1.0, 0.7)
        q = said.pose.pose.orientation
        q.z, q.w = length * q.z, length * q.w
        np.testing.assert_allclose(dispersion_from_message(said, "map")[2:], heading)


@pytest.mark.parametrize("variances", [(-1.0, 1.0), (1.0, np.nan), (1.0, 1e5), (np.inf, 1.0)])
def test_what_is_no_dispersion_is_refused(variances):
    with pytest.raises(MessageError) as caught:
        dispersion_from_message(dispersion(*variances), "map")
    assert caught.value.reason == "dispersion"


def test_guidance_says_how_precisely_it_lands(ros, cells):
    table = {}

    def take(message):
        table["least"] = cloud_records(message, SITE_FIELDS)["probability"].min()

    with ros.listen({}) as listener:
        vehicle = Vehicle(listener, cells)
        listener.node.create_subscription(PointCloud2, "landing/site_table", take, latched())
        says = listener.node.create_publisher(
            PoseWithCovarianceStamped, "landing/dispersion", latched()
        )
        ros.start("lss_node")
        vehicle.send_map(0)
        listener.until(lambda: table)
        by_default = table["least"]
        says.publish(dispersion(36.0, 36.0))
        listener.until(lambda: table["least"] < by_default - 0.02)
        says.publish(dispersion(np.nan, np.nan))
        listener.until(lambda: table["least"] == by_default)
