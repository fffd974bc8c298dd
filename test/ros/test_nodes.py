# SPDX-License-Identifier: Apache-2.0
"""The nodes as processes over DDS."""

import signal

import numpy as np
import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_scene import BLOCK, cloud, events, last_scan_ns, write_bag
from sensor_msgs.msg import PointCloud2

from quadtree_lss import build
from quadtree_lss.desk.exchange.saved import load_results
from quadtree_lss.lab.live.demo import differing, run_live
from quadtree_lss.lab.live.listener import TOPICS
from quadtree_lss.lab.live.processes import program
from quadtree_lss.onboard.messages.maps import SITE_FIELDS
from quadtree_lss.onboard.messages.outputs import cloud_records, map_from_messages
from quadtree_lss.onboard.nodes.node_runner import WRONG_CONFIGURATION

pytestmark = pytest.mark.xdist_group("ros")

SCANS = 6


def grid_values(grid):
    """Values (ny, nx) of an occupancy grid with the centres x (nx,) and y (ny,) of its cells."""
    info = grid.info
    values = np.frombuffer(grid.data, dtype=np.int8).reshape(info.height, info.width)
    x = info.origin.position.x + (np.arange(info.width) + 0.5) * info.resolution
    y = info.origin.position.y + (np.arange(info.height) + 0.5) * info.resolution
    return values, x, y


def agree(listener, keys):
    """Return whether both nodes report the same values where both have them."""
    one, other = (listener.values(name) for name in ("mapping_node", "lss_node"))
    return all(one.get(key) == other.get(key, "") for key in keys)


def test_scans_and_poses_become_ranked_sites(ros):
    ros.start("mapping_node"), ros.start("lss_node")
    with ros.sensors() as (listener, sensors):
        last = sensors.publish(SCANS)
        listener.until_stamped(last, *TOPICS)
        newest = dict(listener.newest)
        listener.until(listener.has, "scans", SCANS)
        listener.until(agree, listener, ("build", "map.stamp_ns", "map.leaves"))
        assert listener.values()["build"] == build.name()

    cells = map_from_messages(newest["map/cells"], newest["map/observed"])
    assert cells.stamp_ns == last
    seen = cells.measured
    assert seen.mean() > 0.5 and cells.estimated.all()
    off_block = seen & ((np.abs(cells.x - 5.5) > 3.5) | (np.abs(cells.y + 5.5) > 3.5))
    assert np.abs(cells.z - 0.02 * cells.x)[off_block].max() < 0.05

    table = cloud_records(newest["landing/site_table"], SITE_FIELDS)
    poses = newest["landing/sites"].poses
    assert newest["landing/sites"].header.frame_id == "map"
    assert 1 <= len(poses) == len(table) <= 3
    assert (np.diff(table["probability"]) <= 0.01).all()  # clearance decides between equals
    grid = newest["landing/probability"]
    assert max(grid.data) == 99 and min(grid.data) < 10
    for place, record in zip(poses, table, strict=True):
        position = [place.position.x, place.position.y, place.position.z]
        np.testing.assert_allclose(position, record[["x", "y", "z"]].tolist(), rtol=0, atol=1e-4)
        distance_x = max(BLOCK[0] - position[0], position[0] - BLOCK[1], 0.0)
        distance_y = max(BLOCK[2] - position[1], position[1] - BLOCK[3], 0.0)
        assert np.hypot(distance_x, distance_y) > 1.5, "the zone touches the block"
        q = place.orientation
        assert np.degrees(np.arccos(1 - 2 * (q.x**2 + q.y**2))) < 5.0
        assert abs(2 * (q.x * q.y + q.z * q.w)) < 1e-6, "+x lies in the map's x-z plane"

    hazards, x, y = grid_values(newest["landing/hazards"])
    on_edge = np.ix_(np.abs(y - BLOCK[2]) < 0.6, np.abs(x - 5.5) < 1.0)
    assert (hazards[on_edge] == 100).any()
    score, _, _ = grid_values(newest["landing/score"])
    assert score.shape == hazards.shape
    assert score.min() >= 0 and score.max() == 100


def test_live_equals_offline_cell_for_cell(ros):
    bag = ros.folder / "flight"
    write_bag(bag, SCANS)
    offline = ros.folder / "offline"
    how = ["--out", offline, "--config", ros.params, "--no-report"]
    done = ros.run(program("replay_bag"), bag, *how)
    assert done.returncode == 0, done.stdout + done.stderr
    results = load_results(offline)
    stamps = results.timing["stamp_ns"].tolist()
    assert len(stamps) == SCANS and stamps[-1] == last_scan_ns(SCANS)

    cells, sites = run_live(bag, ros.params, stamps[-1], ros.folder / "live", rate=2.0)

    assert not differing(offline / "cells.npz", cells)
    assert len(results.positions)
    np.testing.assert_allclose(sites, results.positions, atol=1e-6)


@pytest.mark.slow
def test_ground_topics_are_published_from_the_first_subscriber_on(ros):
    ros.start("mapping_node"), ros.start("lss_node")
    with ros.sensors({"landing/status": PointCloud2}) as (_, sensors):
        last = sensors.map(SCANS, "landing/status")
        for _ in range(2):
            with ros.listen() as late:
                late.until_stamped(last, *TOPICS)


def test_incompatible_qos_is_logged_with_its_fix(ros):
    mapping = ros.start("mapping_node")
    with ros.listen() as listener:
        profile = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
        publisher = listener.node.create_publisher(PointCloud2, "lidar/points", profile)
        listener.until(lambda: "or qos_overrides." in mapping.output())
        assert publisher.get_subscription_count() == 0
    assert "'/lidar/points'" in mapping.output()


@pytest.mark.quick("mapping_node")
@pytest.mark.parametrize("name", ["mapping_node", "lss_node"])
def test_unknown_parameter_is_an_error_that_names_the_nearest(ros, name):
    node = ros.start(name, "-p", "domain.max_levle:=7")
    assert node.process.wait(30.0) == WRONG_CONFIGURATION
    lines = [line for line in node.output().splitlines() if "starting, waiting" not in line]
    assert len(lines) == 1
    assert "domain.max_levle" in lines[0] and "'domain.max_level'" in lines[0]


@pytest.mark.slow
def test_wrong_usage_and_missing_home(ros):
    for arguments in (["--params-file", "none.yaml"], ["-r", "a:b"], ["--wrong"]):
        wrong = ros.run(program("lss_node"), "--ros-args", *arguments)
        assert wrong.returncode == 2 and arguments[-1] in wrong.stderr
        assert "Traceback" not in wrong.stderr and wrong.stderr.splitlines()[-1][:6] == "error:"
    del ros.env["HOME"], ros.env["ROS_LOG_DIR"]
    wrong = ros.run(program("lss_node"), "--rate", "5")
    assert wrong.returncode == 2 and "--rate" in wrong.stderr
    node = ros.start("lss_node")
    with ros.listen() as listener:
        listener.until(lambda: "lss_node" in listener.diagnostics)
    assert node.stop() == 0


@pytest.mark.slow
def test_lost_scans_are_counted(ros):
    """Each scan is either lost and counted, or arrives and is dropped without a pose."""
    depth = ("-p", "qos_overrides./lidar/points.subscription.depth:=1")
    mapping = ros.start("mapping_node", *depth, "-p", "pose.max_wait:=0.2")
    with ros.sensors() as (listener, sensors):
        scans = [cloud(e.stamp_ns, e.points_lidar) for e in events(9) if e.points_lidar is not None]

        def accounted():
            values = listener.values()
            reasons = ("scan_lost", "no_pose", "queue_full")
            return sum(int(values.get(f"problems.{reason}", 0)) for reason in reasons)

        sensors.scans.publish(scans[0])
        listener.until(lambda: accounted() == 1)
        mapping.process.send_signal(signal.SIGSTOP)
        for scan in scans[1:]:
            sensors.scans.publish(scan)
        mapping.process.send_signal(signal.SIGCONT)
        listener.until(lambda: accounted() == len(scans))
