# SPDX-License-Identifier: Apache-2.0
"""Services of mapping_node, landing inputs of lss_node, levels of the diagnostics."""

import functools
import time

import numpy as np
import pytest
from geometry_msgs.msg import PointStamped, PolygonStamped
from ros_scene import ERROR, OK, WARN
from ros_vehicle import point, polygon

from quadtree_lss.onboard.messages.maps import CELL_FIELDS
from quadtree_lss.onboard.messages.outputs import cloud_records
from quadtree_lss.onboard.nodes.qos import latched, stream

pytestmark = pytest.mark.xdist_group("ros_services")

SCANS = 4


def site_places(listener):
    """Ranked sites (K, 2)."""
    poses = listener.newest["landing/sites"].poses
    return np.array([(p.position.x, p.position.y) for p in poses]).reshape(-1, 2)


def test_reset_save_and_load(ros):
    path = ros.folder / "saved.map"
    mapping = ros.start("mapping_node", "-p", f"map_file.path:={path}")
    lss = ros.start("lss_node")
    with ros.sensors() as (listener, sensors):
        call = functools.partial(ros.call, listener)
        missing = call("/mapping_node/load_map")
        assert not missing.success and str(path) in missing.message
        last = sensors.map(SCANS, "landing/sites")
        before = bytes(listener.newest["map/cells"].data)
        assert len(site_places(listener)) > 0
        saved = call("/mapping_node/save_map")
        assert saved.success and str(path) in saved.message

        assert call("/mapping_node/reset").success
        listener.until_stamped(0, "map/cells")
        records = cloud_records(listener.newest["map/cells"], CELL_FIELDS)
        assert np.isnan(records["elevation"]).all() and not records["measured"].any()
        assert max(listener.newest["map/observed"].data) == -1
        listener.until_stamped(0, "landing/sites")
        assert len(site_places(listener)) == 0

        assert call("/mapping_node/load_map").success
        listener.until_stamped(last, "map/cells")
        assert bytes(listener.newest["map/cells"].data) == before
        listener.until_stamped(last, "landing/sites")

        path.write_bytes(path.read_bytes()[:-100])
        refused = call("/mapping_node/load_map")
        assert not refused.success and "\n" not in refused.message
        sensors.map(SCANS, offset_ns=10**10)
    assert "Traceback" not in mapping.output() + lss.output()


def test_live_parameters_area_keep_out_and_target_move_the_sites(ros):
    ros.start("mapping_node"), ros.start("lss_node")
    with ros.sensors() as (listener, sensors):
        make, volatile = listener.node.create_publisher, stream(5, reliable=True)
        area = make(PolygonStamped, "landing/area", volatile)
        keep_out = make(PolygonStamped, "landing/keep_out", latched())
        goal = make(PointStamped, "landing/target", volatile)
        sensors.map(SCANS, "landing/sites")
        free = site_places(listener)
        assert len(free)

        ask = functools.partial(ros.set, listener, "lss_node")
        refused = ask("lss.marign", 1.0)
        assert not refused.successful and "did you mean 'lss.margin'" in refused.reason, refused
        assert ask("lss.margin", 12).successful, "a whole number will do"
        listener.until(lambda: not len(site_places(listener)))
        assert ask("lss.margin", 0.0).successful
        listener.until(_same, listener, free)
        assert ask("lss.max_risk", 0.0).successful
        listener.until(lambda: not len(site_places(listener)))
        assert ask("lss.max_risk", 0.003).successful
        listener.until(_same, listener, free)

        area.publish(polygon([(-15, -15), (0, -15), (0, 15), (-15, 15)]))
        listener.until(_all, listener, lambda p: p[:, 0] <= -1.85)
        keep_out.publish(polygon([(-20, -20), (5, -20), (5, 0), (-20, 0)]))
        both = functools.partial(_all, listener, lambda p: (p[:, 0] <= -1.85) & (p[:, 1] >= 1.85))
        listener.until(both)
        goal.publish(point(-5.0, 4.0))

        def near():
            return _all(listener, lambda p: np.hypot(p[:1, 0] + 5.0, p[:1, 1] - 4.0) < 3.0)

        listener.until(near)

        goal.publish(point(float("inf"), 0.0))
        listener.until(listener.has, "problems.target_point", 1, "lss_node")
        assert both() and near(), "the target that was asked for before still holds"

        area.publish(polygon([]))
        keep_out.publish(polygon([]))
        goal.publish(point(float("nan"), float("nan")))
        listener.until(_same, listener, free)


def _all(listener, condition):
    if "landing/sites" not in listener.newest:
        return False
    places = site_places(listener)
    return len(places) > 0 and bool(np.all(condition(places)))


def _same(listener, places):
    return np.array_equal(site_places(listener), places)


@pytest.mark.slow
def test_levels_follow_the_age_of_the_data(ros):
    limits = ("-p", "diagnostics.warn_age:=0.5", "-p", "lidar.range_noise:=0.02")
    limits += ("-p", "lss.assessment:=touchdown")
    nodes = ("mapping_node", "lss_node")
    for node in nodes:
        ros.start(node, *limits)
    with ros.sensors() as (listener, sensors):
        expected = {"scan.rate_hz", "pose.age_s", "map_ms", "publish_ms", "points.dropped.outside"}

        def fine():
            mapping, lss = (set(listener.values(node)) for node in nodes)
            good = all(listener.told(node, OK) for node in nodes)
            return good and expected <= mapping and {"map.rate_hz", "lss_ms"} <= lss

        listener.until(lambda: listener.diagnostics.keys() >= set(nodes), timeout=40.0)
        deadline, flown = time.monotonic() + 30.0, 0
        while not fine():
            assert time.monotonic() < deadline, listener.diagnostics
            sensors.publish(SCANS, offset_ns=flown * 10**10)
            flown += 1
        for wanted in (WARN, ERROR):
            for node in nodes:
                listener.until(listener.told, node, wanted)
        assert "no scan on '/lidar/points'" in listener.diagnostics["mapping_node"].message
        assert "no map on '/map/cells'" in listener.diagnostics["lss_node"].message


@pytest.mark.slow
def test_no_safe_site_and_wrong_range_noise_are_reported(ros):
    ros.start("mapping_node")
    ros.start("lss_node", "-p", "vehicle.diameter:=40.0")
    with ros.sensors() as (listener, sensors):
        sensors.map(SCANS, "landing/sites")
        assert listener.newest["landing/sites"].poses == []
        levels = WARN + ERROR
        listener.until(listener.told, "lss_node", levels, "no safe site", "20.00 m")
        listener.until(listener.told, "mapping_node", levels, "lidar.range_noise")


@pytest.mark.slow
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
