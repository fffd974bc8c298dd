# SPDX-License-Identifier: Apache-2.0
"""What goes wrong on a vehicle: nodes count it, say so, keep the map and go on."""

from __future__ import annotations

import functools
import signal
import subprocess
import sys
import time
from array import array

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from ros.conftest import status_values
from ros_scene import Sensors, cloud, gimbal, level_body, pose
from sensor_msgs.msg import PointField

from quadtree_lss.configuration import load_config
from quadtree_lss.core.mapping import Mapper
from quadtree_lss.ros.map_files import Checkpoints, MapFileError, load, save, write_atomically
from quadtree_lss.ros.qos import stream

pytestmark = pytest.mark.xdist_group("ros_faults")

SCANS = 4
TEN_SECONDS_NS = 10**10


def has(listener, key, number, node="mapping_node"):
    """True if a diagnostic value is this number."""
    return status_values(listener, node).get(key) == str(number)


def at_least(listener, key, number, node="mapping_node"):
    """True if a diagnostic value is this number or more."""
    return int(status_values(listener, node).get(key, 0)) >= number


@pytest.fixture
def flight(ros):
    """A mapping node with sensors: listener, sensors, process."""
    mapping = ros.start("mapping_node", "-p", "pose.max_wait:=0.3")
    with ros.listen() as listener:
        sensors = Sensors(listener)
        sensors.wait_for_subscribers()
        yield listener, sensors, mapping
        mapping.check()
        assert "Traceback" not in mapping.output()


def test_poses_stop_and_resume(flight):
    listener, sensors, mapping = flight
    sensors.publish(SCANS)
    sensors.publish(SCANS, offset_ns=TEN_SECONDS_NS, make_pose=lambda stamp: None)
    dropped = functools.partial(has, listener, "scans.dropped.no_pose", SCANS)
    assert listener.wait_for(dropped), mapping.output()
    last = sensors.publish(SCANS, offset_ns=2 * TEN_SECONDS_NS)
    assert listener.wait_for(lambda: listener.stamp("map/cells") == last), mapping.output()
    assert listener.wait_for(lambda: has(listener, "scans", 2 * SCANS))
    lines = [line for line in mapping.output().splitlines() if "no longer sent" in line]
    assert len(lines) == 1, "one line for all of them"


def test_poses_out_of_order_serve_as_well(flight):
    listener, sensors, mapping = flight
    first, late = [], []

    def two_at_a_time(stamp):
        """The later of two comes first; the very first in time, or all before it are too old."""
        if not first:
            first.append(stamp)
            return pose(stamp)
        late.append(pose(stamp))
        return [late.pop(), late.pop()] if len(late) == 2 else None

    sensors.publish(SCANS, make_pose=two_at_a_time)
    enough = functools.partial(at_least, listener, "scans", SCANS - 1)  # the last may lack one
    assert listener.wait_for(enough), mapping.output()
    assert not any(
        key.startswith("problems.pose") for key in status_values(listener, "mapping_node")
    )


def test_time_jumps_back_and_forward(flight):
    listener, sensors, mapping = flight
    # The second pass is a looping bag. At a jump itself scans that still wait may be dropped.
    for done, offset_ns in enumerate((TEN_SECONDS_NS, 0, 10**6 * 10**9), start=1):
        later = sensors.publish(SCANS, offset_ns=offset_ns)
        mapped = functools.partial(has, listener, "scans", done * SCANS)
        assert listener.wait_for(mapped), mapping.output()
    assert listener.wait_for(lambda: listener.stamp("map/cells") == later), mapping.output()
    assert listener.wait_for(lambda: at_least(listener, "problems.time_jump", 1))
    assert "jumped back" in mapping.output()


def test_unknown_and_invalid_covariances(flight):
    listener, sensors, mapping = flight

    def unknown(stamp):
        message = pose(stamp)
        message.pose.covariance = np.zeros(36)
        return message

    def invalid(stamp):
        message = pose(stamp)
        message.pose.covariance[1] = 5.0
        return [message, pose(stamp)]

    sensors.publish(SCANS, make_pose=unknown)
    last = sensors.publish(SCANS, offset_ns=TEN_SECONDS_NS, make_pose=invalid)
    assert listener.wait_for(lambda: listener.stamp("map/cells") == last), mapping.output()
    for key in ("pose_covariance_unknown", "pose_covariance"):
        told = functools.partial(at_least, listener, f"problems.{key}", SCANS)
        assert listener.wait_for(told), key


def packed(stamp_ns, columns, names, *, kind="<f4", height=1, step=None, row_pad=0):
    """Cloud of columns (N, 3) with padded points and rows."""
    dtype, width = np.dtype(kind), len(columns) // height
    step = step or 3 * dtype.itemsize
    message = cloud(stamp_ns, np.zeros((1, 1, 3)))
    message.height, message.width, message.point_step = height, width, step
    message.row_step = width * step + row_pad
    code = PointField.FLOAT32 if dtype.itemsize == 4 else PointField.FLOAT64
    message.fields = [
        PointField(name=name, offset=k * dtype.itemsize, datatype=code, count=1)
        for k, name in enumerate(names)
    ]
    raw = np.zeros((height, message.row_step), np.uint8)
    points = np.zeros((len(columns), step), np.uint8)
    points[:, : 3 * dtype.itemsize] = columns.astype(kind).view(np.uint8).reshape(len(columns), -1)
    raw[:, : width * step] = points.reshape(height, -1)
    message.data = array("B", raw.tobytes())
    message.is_bigendian = kind.startswith(">")
    return message


def layouts(stamp_ns, points):
    """The same scan in legal layouts; the stamp tells which."""
    flat, rows = points.reshape(-1, 3), len(points)
    distance = np.linalg.norm(flat, axis=1)
    azimuth = np.arctan2(flat[:, 0], flat[:, 2])
    elevation = np.arcsin(-flat[:, 1] / distance)
    angles = np.column_stack([distance, azimuth, elevation])
    xyz, spherical = ("x", "y", "z"), ("range", "azimuth", "elevation")
    made = (
        lambda t: packed(t, flat, xyz, kind="<f8"),
        lambda t: packed(t, flat, xyz, kind=">f4", height=rows, step=32, row_pad=5),
        lambda t: packed(t, angles, spherical, kind=">f8", height=rows),
        lambda t: packed(t, flat[:, ::-1], ("z", "y", "x"), step=13),
    )
    return made[(stamp_ns // 100_000_000) % len(made)](stamp_ns)


def test_every_legal_layout_maps_all_points(flight):
    listener, sensors, mapping = flight
    last = sensors.publish(SCANS, make_cloud=layouts)
    assert listener.wait_for(lambda: listener.stamp("map/cells") == last), mapping.output()
    assert listener.wait_for(lambda: has(listener, "scans", SCANS)), mapping.output()
    values = status_values(listener, "mapping_node")
    dropped = {key: value for key, value in values.items() if key.startswith("points.dropped")}
    assert set(dropped.values()) == {"0"}, dropped


def test_a_second_publisher_is_told_and_no_loss_invented(flight):
    listener, sensors, mapping = flight
    sensors.publish(SCANS)
    second = Sensors(listener)
    for problem in ("scan_publishers", "pose_publishers"):
        told = functools.partial(at_least, listener, f"problems.{problem}", 1)
        assert listener.wait_for(told), mapping.output()
    for k in (1, 2, 3):
        (sensors, second)[k % 2].publish(2, offset_ns=k * TEN_SECONDS_NS)
    total = functools.partial(has, listener, "scans", SCANS + 6)
    assert listener.wait_for(total), mapping.output()
    assert "problems.scan_lost" not in status_values(listener, "mapping_node")


@pytest.mark.parametrize("moving", [False, True])
def test_mounts_give_the_map_of_the_lidars_own_poses(ros, moving):
    own = ros.start("mapping_node")
    with ros.listen() as listener:
        sensors = Sensors(listener)
        sensors.wait_for_subscribers()
        last = sensors.publish(SCANS)
        assert listener.wait_for(lambda: listener.stamp("map/observed") == last), own.output()
        wanted = np.frombuffer(listener.newest["map/observed"].data, np.int8)
    own.stop()
    static = ("-p", "mount.z:=-2.0", "-p", "mount.roll_deg:=180.0")
    mapping = ros.start("mapping_node", *(("-p", "mount.gimbal:=true") if moving else static))
    with ros.listen() as listener:
        sensors = Sensors(listener)
        publisher = listener.node.create_publisher(
            TransformStamped, "lidar/gimbal", stream(100, reliable=True)
        )
        sensors.wait_for_subscribers()
        assert publisher.get_subscription_count() == int(moving)

        def on_pose(stamp):
            if moving:
                publisher.publish(gimbal(stamp, (0.0, 0.0, -2.0)))

        body = functools.partial(level_body, above=2.0)
        last = sensors.publish(SCANS, make_pose=body, on_pose=on_pose)
        assert listener.wait_for(lambda: listener.stamp("map/observed") == last), mapping.output()
        found = np.frombuffer(listener.newest["map/observed"].data, np.int8)
    assert (found != wanted).mean() < 1e-3


def test_killed_mapping_node_takes_up_its_checkpoint(ros):
    """The sensors stay and are heard by the successor, as on a vehicle."""
    path = ros.folder / "checkpoint.map"
    args = ("-p", f"checkpoint.path:={path}", "-p", "checkpoint.interval:=0.1")
    mapping = ros.start("mapping_node", *args)
    with ros.listen() as listener:
        sensors = Sensors(listener)
        sensors.wait_for_subscribers()
        last = sensors.publish(SCANS)
        assert listener.wait_for(lambda: listener.stamp("map/cells") == last), mapping.output()
        before = bytes(listener.newest["map/cells"].data)
        assert listener.wait_for(lambda: _stamp_in(path) == last), mapping.output()
        mapping.process.kill()
        mapping.process.wait(10.0)
        listener.newest.clear()
        again = ros.start("mapping_node", *args)
        assert listener.wait_for(lambda: listener.stamp("map/cells") == last), again.output()
        assert bytes(listener.newest["map/cells"].data) == before
        assert "taken up" in again.output()
        later = _publish_until_mapped(listener, sensors, 1)
        assert later, again.output()
        assert ros.call(listener, "/mapping_node/reset").success
        assert not path.exists(), "a reset forgets the checkpoint, too"
        last = sensors.publish(SCANS, offset_ns=100 * TEN_SECONDS_NS)
        assert listener.wait_for(lambda: listener.stamp("map/cells") == last), again.output()
    assert again.stop() == 0
    assert _stamp_in(path) == last, "a clean end leaves the last state"


def _publish_until_mapped(listener, sensors, first, topic="map/cells"):
    """Sends scans, from ``first`` times ten seconds on, until one is in; its stamp or None.

    That a killed node's successor has subscribed cannot be seen by number of subscribers: the
    killed one counts until its lease ends.
    """
    for k in range(first, first + 30):
        last = sensors.publish(SCANS, offset_ns=k * TEN_SECONDS_NS)
        if listener.wait_for(lambda last=last: listener.stamp(topic) == last, timeout=1.0):
            return last
    return None


def _stamp_in(path):
    mapper = Mapper(load_config(overrides=SMALL))
    try:
        load(path, mapper)
    except MapFileError:
        return None
    return mapper.stamp_ns


SMALL = {
    "domain": {"xmin": -16.0, "ymin": -16.0, "size": 32.0, "min_level": 3, "max_level": 6},
}


def test_damaged_checkpoint_is_set_aside_and_mapping_goes_on(ros):
    path = ros.folder / "checkpoint.map"
    path.write_bytes(b"PK\x03\x04 something else")
    mapping = ros.start("mapping_node", "-p", f"checkpoint.path:={path}")
    with ros.listen() as listener:
        sensors = Sensors(listener)
        sensors.wait_for_subscribers()
        last = sensors.publish(SCANS)
        assert listener.wait_for(lambda: listener.stamp("map/cells") == last), mapping.output()
        assert listener.wait_for(lambda: has(listener, "problems.checkpoint", 1))
    assert path.with_name("checkpoint.map.refused").exists()
    assert "starting with an empty map" in mapping.output()
    assert "Traceback" not in mapping.output()


def test_checkpoint_that_cannot_be_written_is_told_and_costs_nothing_else(ros):
    path = ros.folder / "checkpoint.map"
    path.with_name("checkpoint.map.part").symlink_to("/dev/full")
    args = ("-p", f"checkpoint.path:={path}", "-p", "checkpoint.interval:=0.1")
    mapping = ros.start("mapping_node", *args)
    with ros.listen() as listener:
        sensors = Sensors(listener)
        sensors.wait_for_subscribers()
        last = sensors.publish(SCANS)
        assert listener.wait_for(lambda: listener.stamp("map/cells") == last), mapping.output()
        assert listener.wait_for(lambda: at_least(listener, "problems.checkpoint", 3))
        lines = [line for line in mapping.output().splitlines() if "No space left" in line]
        assert len(lines) == 1, "told once, though it fails again and again"
        path.with_name("checkpoint.map.part").unlink()
        assert listener.wait_for(path.exists), "written once there is room again"
    assert mapping.stop() == 0


def test_a_checkpoint_that_cannot_be_removed_does_not_hold_up_a_reset(ros):
    path = ros.folder / "checkpoint.map"
    mapping = ros.start("mapping_node", "-p", f"checkpoint.path:={path}")
    with ros.listen() as listener:
        sensors = Sensors(listener)
        sensors.wait_for_subscribers()
        last = sensors.publish(SCANS)
        assert listener.wait_for(lambda: listener.stamp("map/cells") == last), mapping.output()
        assert listener.wait_for(path.exists), mapping.output()
        path.unlink()
        path.mkdir()
        answer = ros.call(listener, "/mapping_node/reset")
        assert answer.success, answer.message
        assert listener.wait_for(lambda: listener.stamp("map/cells") == 0), mapping.output()
        assert listener.wait_for(lambda: at_least(listener, "problems.checkpoint", 1))
        assert "cannot be removed" in mapping.output()


def test_a_writer_killed_at_any_moment_leaves_a_whole_file(tmp_path):
    path, part = tmp_path / "map", tmp_path / "map.part"
    program = (
        "from pathlib import Path; import sys\n"
        "from quadtree_lss.ros.map_files import write_atomically\n"
        "while True:\n"
        "    for letter in (b'a', b'b'):\n"
        "        write_atomically(Path(sys.argv[1]), letter * 30_000_000)\n"
    )
    killed_while_writing = 0
    for _ in range(6):
        child = subprocess.Popen([sys.executable, "-c", program, str(path)], cwd=tmp_path)
        while not path.exists() or not part.exists():
            assert child.poll() is None
            time.sleep(0.002)
        child.send_signal(signal.SIGKILL)
        child.wait()
        killed_while_writing += part.exists()
        content = path.read_bytes()
        assert len(content) == 30_000_000 and len(set(content[:: 10**6] + content[-1:])) == 1
    assert killed_while_writing, "at least one was in the middle"
    write_atomically(path, b"new")
    assert path.read_bytes() == b"new" and not part.exists()


def test_map_files_survive_what_disks_do(tmp_path):
    mapper = Mapper(load_config(overrides=SMALL))
    file = tmp_path / "file"
    file.write_text("x")
    for path in (tmp_path / "none" / "map", file / "map", tmp_path):
        with pytest.raises(MapFileError, match=str(path)):
            save(path, mapper)
        with pytest.raises(MapFileError, match=str(path)):
            load(path, mapper)
    checkpoints = Checkpoints(tmp_path / "map")
    checkpoints.changed()
    assert checkpoints.close(mapper) is None and checkpoints.written == 1
    assert "taken up" in checkpoints.take_up(mapper)
    checkpoints.forget()
    assert "no checkpoint" in checkpoints.take_up(mapper)
    other = Mapper(load_config(overrides={**SMALL, "domain.max_level": 7}))
    save(tmp_path / "map", other)
    with pytest.raises(MapFileError, match="another domain"):
        checkpoints.take_up(mapper)
    assert (tmp_path / "map.refused").exists() and not (tmp_path / "map").exists()


@pytest.mark.slow
def test_both_nodes_recover_from_kills_while_sensors_stay(ros):
    path = ros.folder / "checkpoint.map"
    args = ("-p", f"checkpoint.path:={path}", "-p", "checkpoint.interval:=0.05")
    nodes = {name: ros.start(name, *args) for name in ("mapping_node", "lss_node")}
    rng = np.random.default_rng(5)
    with ros.listen() as listener:
        sensors = Sensors(listener)
        sensors.wait_for_subscribers()
        for attempt in range(8):
            newest = _publish_until_mapped(listener, sensors, 100 * attempt, "landing/sites")
            assert newest, "".join(node.output() for node in nodes.values())
            time.sleep(0.2 + 0.3 * rng.random())
            name = ("mapping_node", "lss_node")[attempt % 2]
            nodes[name].process.kill()
            nodes[name].process.wait(10.0)
            listener.newest.clear()
            nodes[name] = ros.start(name, *args)
            topic = {"mapping_node": "map/cells", "lss_node": "landing/sites"}[name]
            kept = functools.partial(_newer, listener, topic, newest)
            assert listener.wait_for(kept), nodes[name].output()


def _newer(listener, topic, stamp_ns):
    found = listener.stamp(topic)
    return found is not None and found >= stamp_ns
