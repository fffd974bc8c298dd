# SPDX-License-Identifier: Apache-2.0
"""A bag with body poses and a gimbal: the nodes and the replay make the same map of it."""

import subprocess

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from ros_scene import cloud, events, gimbal, level_body
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from quadtree_lss.desk.exchange.saved import cells_arrays, load_results
from quadtree_lss.desk.replay.files import write_npz
from quadtree_lss.lab.live.demo import differing, run_live
from quadtree_lss.lab.live.processes import program

pytestmark = pytest.mark.xdist_group("ros_faults")

SCANS = 4
ABOVE = 2.0
TYPES = {
    "/lidar/points": "sensor_msgs/msg/PointCloud2",
    "/nav/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/lidar/gimbal": "geometry_msgs/msg/TransformStamped",
}


def write_bag(path):
    """The scene as a level body with the lidar on a gimbal below it records it."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topics = {t: bag.add_connection(t, kind, typestore=store) for t, kind in TYPES.items()}

        def write(topic, stamp, message):
            bag.write(topics[topic], stamp, serialize_message(message))

        for event in events(SCANS):
            stamp = event.stamp_ns
            if event.points_lidar is not None:
                write("/lidar/points", stamp, cloud(stamp, event.points_lidar))
                continue
            write("/lidar/gimbal", stamp, gimbal(stamp, (0.0, 0.0, -ABOVE)))
            write("/nav/pose", stamp, level_body(stamp, ABOVE))


def replay(ros, bag, out, *settings):
    command = [program("replay_bag"), bag, "--out", out, "--config", ros.params, "--no-report"]
    for setting in settings:
        command += ["--set", setting]
    done = subprocess.run(
        [str(part) for part in command], env=ros.env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return out


def test_a_gimballed_bag_live_and_offline(ros):
    bag = ros.folder / "flight"
    write_bag(bag)
    static = replay(ros, bag, ros.folder / "static", f"mount.z={-ABOVE}", "mount.roll_deg=180.0")
    ros.params.write_text(ros.params.read_text() + "    mount.source: gimbal\n")
    moving = replay(ros, bag, ros.folder / "moving")
    with np.load(static / "cells.npz") as one, np.load(moving / "cells.npz") as other:
        assert one["measured"].mean() > 0.5
        np.testing.assert_array_equal(one["level"], other["level"])
        np.testing.assert_allclose(one["z"], other["z"], atol=1e-9)
    stamps = load_results(moving).timing["stamp_ns"].tolist()
    assert len(stamps) == SCANS
    live = run_live(bag, ros.params, stamps[-1], ros.folder / "live")
    write_npz(ros.folder / "live.npz", cells_arrays(live.cells))
    assert not differing(moving / "cells.npz", ros.folder / "live.npz")
