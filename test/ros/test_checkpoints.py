# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of a running node."""

import resource
import shutil
import signal

import pytest
from ros.test_map_files import small
from ros_scene import ERROR

from quadtree_lss.onboard.nodes.map_files import MapFileError, load

pytestmark = pytest.mark.xdist_group("ros_checkpoints")

SCANS = 4
TEN_SECONDS_NS = 10**10
FAULTY = """
import quadtree_lss.onboard.core.mapping.mapper as mapper

whole = mapper.Mapper.update
left = [3]

def update(self, *scan):
    left[0] -= 1
    if left[0] == -1:
        self.leaves.reset()
        self.stamp_ns = 1
        raise ValueError("math domain error")
    return whole(self, *scan)

mapper.Mapper.update = update
"""
"""Three scans are mapped; the fourth raises an error after it has damaged the map."""


def keeping(ros):
    """Return the path of a checkpoint, and the arguments with which a node writes it."""
    path = ros.folder / "checkpoint.map"
    return path, ("-p", f"checkpoint.path:={path}")


def test_killed_mapping_node_restores_its_checkpoint(ros):
    """The sensors continue and the new node receives them, as on a vehicle."""
    path, args = keeping(ros)
    mapping = ros.start("mapping_node", *args)
    with ros.sensors() as (listener, sensors):
        last = sensors.map(SCANS)
        before = bytes(listener.newest["map/cells"].data)
        listener.until(lambda: _stamp_in(path) == last)
        mapping.process.kill()
        mapping.process.wait(10.0)
        listener.newest.clear()
        again = ros.start("mapping_node", *args)
        listener.until_stamped(last, "map/cells")
        assert bytes(listener.newest["map/cells"].data) == before
        assert "taken up" in again.output()
        assert _publish_until_mapped(listener, sensors), again.output()
        assert ros.call(listener, "/mapping_node/reset").success
        assert not path.exists(), "a reset forgets the checkpoint, too"
        last = sensors.map(SCANS, offset_ns=100 * TEN_SECONDS_NS)
    assert again.stop(signal.SIGHUP) == 0
    assert _stamp_in(path) == last, "a clean end leaves the last state"


def _publish_until_mapped(listener, sensors):
    """Sends scans until one is in: that a killed node's successor has subscribed cannot be seen by
    the number of subscribers, for the killed one counts until its lease ends."""
    for k in range(1, 31):
        last = sensors.publish(SCANS, offset_ns=k * TEN_SECONDS_NS)
        if listener.wait_for(lambda last=last: listener.stamp("map/cells") == last, timeout=1.0):
            return True
    return False


def _stamp_in(path):
    mapper = small()
    try:
        load(path, mapper)
    except MapFileError:
        return None
    return mapper.stamp_ns


@pytest.mark.slow
def test_unwritable_checkpoint_is_reported_and_has_no_other_effect(ros):
    path, args = keeping(ros)
    mapping = ros.start("mapping_node", *args)
    before = resource.prlimit(mapping.process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(mapping.process.pid, resource.RLIMIT_FSIZE, (20_000, before[1]))
    with ros.sensors() as (listener, sensors):
        sensors.map(SCANS)
        listener.until(listener.at_least, "problems.checkpoint", 3)
        lines = [line for line in mapping.output().splitlines() if "File too large" in line]
        assert len(lines) == 1, "told once, though it fails again and again"
        assert not path.exists()
        resource.prlimit(mapping.process.pid, resource.RLIMIT_FSIZE, before)
        listener.until(path.exists)  # written once there is room again
    assert mapping.stop() == 0


@pytest.mark.slow
def test_failed_last_checkpoint_is_logged(ros):
    """It is logged even if another problem was logged recently."""
    folder = ros.folder / "disk"
    folder.mkdir()
    mapping = ros.start("mapping_node", "-p", f"checkpoint.path:={folder / 'a.map'}")
    with ros.sensors() as (listener, sensors):
        sensors.publish(SCANS)
        listener.until((folder / "a.map").exists)
        shutil.rmtree(folder)
        sensors.publish(SCANS, offset_ns=TEN_SECONDS_NS)
        listener.until(listener.at_least, "problems.checkpoint", 1)
    assert mapping.stop() == 0
    last = mapping.output().splitlines()[-1]
    assert "are lost" in last and "[ERROR]" in last


@pytest.mark.slow
@pytest.mark.parametrize("kept", [True, False])
def test_scan_with_an_error_is_dropped_and_the_node_continues(ros, kept):
    """After any exception the map may be inconsistent."""
    path, args = keeping(ros)
    faulty = ros.start("mapping_node", *(args if kept else ()), first=FAULTY)
    with ros.sensors() as (listener, sensors):
        good = sensors.publish(SCANS - 1)
        listener.until_stamped(good, "map/cells")
        listener.until(lambda: not kept or _stamp_in(path) == good)
        leaves = len(listener.newest["map/cells"].data)
        sensors.publish(1, offset_ns=TEN_SECONDS_NS)

        how = "that of the checkpoint" if kept else "consistent and kept"
        listener.until(listener.told, "mapping_node", ERROR, how)
        assert "ValueError" in listener.diagnostics["mapping_node"].message
        assert listener.has("problems.scan_failed", 1)
        listener.until(lambda: not kept or _stamp_in(path) == good)
        last = sensors.publish(1, offset_ns=2 * TEN_SECONDS_NS)
        listener.until_stamped(last, "map/cells")
        assert not kept or len(listener.newest["map/cells"].data) >= leaves
        listener.until(lambda: "failed" not in listener.diagnostics["mapping_node"].message)
    assert faulty.stop(signal.SIGTERM) == 0
    assert "ValueError: math domain error" in faulty.output()
