# SPDX-License-Identifier: Apache-2.0
"""Scans that come faster than they can be mapped."""

import signal
import time
from types import SimpleNamespace

import pytest
from ros_scene import cloud, pose
from sensor_msgs.msg import PointCloud2

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.onboard.messages.clouds import stamp_ns
from quadtree_lss.onboard.nodes import losses
from quadtree_lss.onboard.nodes.diagnostics import Problems
from quadtree_lss.onboard.nodes.losses import CALM_S, OVERLOADED_SHARE, Overload, allowance
from quadtree_lss.onboard.nodes.qos import latched

pytestmark = pytest.mark.xdist_group("ros_faults")

EPOCH_NS = 1_700_000_000 * 10**9

SLOW = """
import time
import quadtree_lss.onboard.core.mapping.mapper as mapper

whole = mapper.Mapper.update

def update(self, *scan):
    time.sleep(0.12)
    return whole(self, *scan)

mapper.Mapper.update = update
"""
"""Mapping a scan takes four times the period of scans."""


def test_only_an_overload_drops_scans(monkeypatch):
    def received(waited):
        return EPOCH_NS - round(1e9 * waited)

    clock = SimpleNamespace(time_ns=lambda: EPOCH_NS, monotonic=lambda: clock.now, now=100.0)
    monkeypatch.setattr(losses, "time", clock)
    config, busy = load_config(), 50.0
    limit = allowance(config, busy)
    overload = Overload("scans", Problems(SimpleNamespace(warning=print)))
    assert overload.admits(received(0.9 * limit), config, busy)
    assert not overload.admits(received(1.1 * limit), config, busy)
    assert not overload.admits(received(0.9 * limit), config, busy), "overloaded now"
    assert overload.admits(received(0.8 * OVERLOADED_SHARE * limit), config, busy)
    clock.now += 1.01 * CALM_S
    assert overload.admits(received(0.9 * limit), config, busy), "calm again"
    assert overload.admits(0, config, busy), "the middleware does not say when it came"
    assert overload.admits(received(-100.0), config, busy), "the clock was set back"
    assert overload.dropped == 2 and overload.waits.pop_span().worst < 1e3 * limit


@pytest.mark.slow
def test_overloaded_node_drops_and_counts_scans(ros):
    node, maps = ros.start("mapping_node", "-p", "diagnostics.warn_age:=1.0", first=SLOW), []
    with ros.sensors({}) as (listener, sensors):
        keep = lambda message: maps.append(stamp_ns(message.header))  # noqa: E731
        listener.node.create_subscription(PointCloud2, "map/cells", keep, latched())
        now = {"make_cloud": lambda stamp, points: cloud(time.time_ns(), points)}
        now["make_pose"] = lambda stamp: pose(time.time_ns())
        for _ in range(2):
            sensors.publish(60, **now)
        listener.until(all_accounted, listener.values)
        assert len(maps) > 10 and maps == sorted(maps)
        values = listener.values()
        assert 0 < int(values["scans.dropped.overload"]) == int(values["problems.overload"])
        assert node.stop(signal.SIGTERM, 60.0) == 0


def all_accounted(values):
    """Return whether every received scan was mapped, waits, or was dropped for a reason."""
    found = {key: int(value) for key, value in values().items() if value.isdigit()}
    dropped = sum(number for key, number in found.items() if key.startswith("scans.dropped."))
    total = found.get("scans", 0) + found.get("scans.waiting", 0) + dropped
    return found.get("scan.received") == total == 120
