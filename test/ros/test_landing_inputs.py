# SPDX-License-Identifier: Apache-2.0
"""No site inside a keep-out or outside an area that was published."""

import dataclasses
import signal

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from ros_scene import map_messages
from ros_vehicle import Vehicle, polygon

from quadtree_lss.onboard.nodes.landing_topics import JOIN_S, UNHEARD_S

pytestmark = pytest.mark.xdist_group("ros_landing")

EVERYWHERE = [(-16, -16), (16, -16), (16, 16), (-16, 16)]
WEST = [(-16, -16), (5, -16), (5, 16), (-16, 16)]
PATIENT = ("-p", "diagnostics.warn_age:=60.0")
"""Maps come once per second, the default limit of a warning, so the limit is raised."""


@pytest.fixture
def vehicle(ros, cells):
    with ros.listen({}) as listener:
        yield Vehicle(listener, cells)


def anywhere(places):
    return np.isfinite(places[:, 0])


def east(places):
    return places[:, 0] >= 5.0


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_no_site_before_a_required_input(ros, vehicle):
    """It may come later than all waiting times."""
    ros.start("lss_node", "-p", "lss.required_input:=keep_out")
    stamp = vehicle.send_map(0)
    vehicle.until(vehicle.told, DiagnosticStatus.WARN, "waiting for", "landing/keep_out")
    assert not vehicle.listener.wait_for(lambda: vehicle.said, timeout=JOIN_S + UNHEARD_S + 1.0)
    vehicle.send("landing/keep_out", polygon(WEST))
    vehicle.until(vehicle.sites_of, stamp, anywhere)
    assert all(east(places).all() for _, _, places in vehicle.said), vehicle.said


@pytest.mark.slow
def test_keep_out_is_checked_against_the_frame_of_the_map(ros, vehicle):
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


def test_no_site_while_the_last_polygon_is_unusable(ros, vehicle):
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


@pytest.mark.slow
def test_messages_of_different_maps_are_not_joined(ros, vehicle):
    """Include messages of one stamp that belong to two maps, and of two frames."""
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
