# SPDX-License-Identifier: Apache-2.0
"""Rejected maps: the age of the last usable map increases, and sites are withdrawn."""

import dataclasses
import signal
from types import SimpleNamespace

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from ros_scene import map_messages
from ros_vehicle import Vehicle

from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.nodes import received_map
from quadtree_lss.onboard.nodes.diagnostics import Problems
from quadtree_lss.onboard.nodes.received_map import ReceivedMap

pytestmark = pytest.mark.xdist_group("ros_landing")


LOG = SimpleNamespace(warning=print)


@pytest.fixture
def received():
    return ReceivedMap(Problems(LOG), "map", LssConfig, binding=False)


def broken(cells):
    """Return the map with one leaf at a height of 20,000 km."""
    z = cells.z.copy()
    z[0] = 2e7
    return dataclasses.replace(cells, z=z, stamp_ns=cells.stamp_ns + 1)


def give(received, cells):
    cloud, grid = map_messages(cells, "map")
    assert not received.add_half("observed", grid)
    assert received.add_half("cells", cloud)


def test_rejected_map_does_not_refresh_the_previous_one(monkeypatch, received, cells):
    give(received, cells)
    received.decode_newest()
    first, age = received.cells, received.arrivals.age()
    give(received, broken(cells))
    received.decode_newest()
    assert received.cells is first and received.arrivals.count == 1 and received.refusals == 1
    assert received.arrivals.age() > age and "cannot be used" in received.refused
    assert not received.withdrawal_reason()
    monkeypatch.setattr(received_map, "MAX_MAP_AGE_S", 1e-9)
    assert "cannot be used" in received.withdrawal_reason()
    give(received, cells)
    assert received.withdrawal_reason() and not received.refused, "what waits is looked at first"
    assert received.arrivals.count == 2


#: Withdraws its sites sooner.
IMPATIENT = "from quadtree_lss.onboard.nodes import received_map; received_map.MAX_MAP_AGE_S = 8.0"


@pytest.mark.slow
def test_sites_are_withdrawn_when_maps_are_rejected_for_too_long(ros, cells):
    ros.start("lss_node", "-p", "diagnostics.warn_age:=3.0", first=IMPATIENT)
    with ros.listen({}) as listener:
        vehicle = Vehicle(listener, cells)
        stamp = vehicle.send_map(0)
        vehicle.until(vehicle.sites_of, stamp, lambda at: at[:, :1] < 1e9)
        stamp = vehicle.send_map(1)
        vehicle.until(vehicle.sites_of, stamp, lambda at: at[:, :1] < 1e9)
        said = len(vehicle.said)
        vehicle.cells = broken(cells)
        for k in range(2, 8):
            vehicle.send_map(k)
            vehicle.until(vehicle.has, "map.refused", k - 1)
            if k == 2:
                vehicle.until(vehicle.told, DiagnosticStatus.ERROR, "cannot be used")
                assert len(vehicle.said) == said, "nothing is said again of the map before"
        vehicle.until(vehicle.none_of, stamp)
        vehicle.until(vehicle.told, DiagnosticStatus.ERROR, "for 8 s", "plane")
        values = vehicle.values()
        assert values["map.received"] == "2" and float(values["map.age_s"]) >= 8.0
        vehicle.cells = cells
        stamp = vehicle.send_map(9)
        vehicle.until(vehicle.sites_of, stamp, lambda at: at[:, :1] < 1e9)
        vehicle.until(vehicle.told, DiagnosticStatus.OK, "sites")


FAULTY = """
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector

whole, stamps = LandingSiteSelector.assess, set()

def assess(self, cells, **wanted):
    stamps.add(cells.stamp_ns)
    if len(stamps) == 3:
        raise OverflowError("math range error")
    return whole(self, cells, **wanted)

LandingSiteSelector.assess = assess
"""
"""The assessment of the third map raises an error."""


@pytest.mark.slow
def test_failed_assessment_withholds_sites_and_the_node_continues(ros, cells):
    faulty = ros.start("lss_node", "-p", "diagnostics.warn_age:=60.0", first=FAULTY)
    with ros.listen({}) as listener:
        vehicle = Vehicle(listener, cells)
        for k in range(2):
            stamp = vehicle.send_map(k)
            vehicle.until(vehicle.sites_of, stamp, lambda at: at[:, :1] < 1e9)
        stamp = vehicle.send_map(2)
        vehicle.until(vehicle.none_of, stamp)
        words = ("no site is given out", "OverflowError", "math range error")
        vehicle.until(vehicle.told, DiagnosticStatus.ERROR, *words)
        assert vehicle.values()["target.reason"] == "withheld"
        for k in (3, 4):
            stamp = vehicle.send_map(k)
            vehicle.until(vehicle.sites_of, stamp, lambda at: at[:, :1] < 1e9)
        vehicle.until(vehicle.told, DiagnosticStatus.OK, "sites")
        assert int(vehicle.values()["problems.pass_failed"]) >= 1
    assert faulty.stop(signal.SIGTERM) == 0
    assert "OverflowError: math range error" in faulty.output()


def test_missing_messages_of_the_first_map(received, cells):
    cloud, grid = map_messages(cells, "map")
    assert "nothing came" in received.missing()
    received.add_half("cells", cloud)
    assert "map/cells came, the other half" in received.missing()
    later = dataclasses.replace(cells, stamp_ns=1)
    received.add_half("observed", map_messages(later, "map")[1])
    assert "both halves of one stamp did not" in received.missing()
    received.add_half("observed", grid)
    received.decode_newest()
    assert not received.missing()


@pytest.mark.slow
def test_waiting_nodes_log_missing_inputs(ros):
    lss, mapping = ros.start("lss_node"), ros.start("mapping_node")
    with ros.listen({}) as listener:
        told = "waiting for a map: nothing came (publishers known on '/map/cells': "
        listener.until(lambda: told in lss.output())
        told = "waiting for '/lidar/points' (publishers known: 0) and '/nav/pose'"
        listener.until(lambda: told in mapping.output())
