# SPDX-License-Identifier: Apache-2.0
"""``landing/selected`` over DDS: held, withdrawn with a reason, released, missed deadline."""

import dataclasses
import itertools
import signal

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSProfile
from ros_scene import MAKE
from ros_vehicle import Vehicle, polygon
from sensor_msgs.msg import PointCloud2

from quadtree_lss.onboard.core.landing.target import Reason, State
from quadtree_lss.onboard.messages.clouds import stamp_ns
from quadtree_lss.onboard.messages.maps import SITE_FIELDS, STATUS_FIELDS
from quadtree_lss.onboard.messages.outputs import cloud_records
from quadtree_lss.onboard.nodes.qos import latched, stream, target

pytestmark = pytest.mark.xdist_group("ros_target")


class Pilot(Vehicle):
    """Vehicle that also records each change of the target, with position and status."""

    def __init__(self, listener, cells):
        super().__init__(listener, cells)
        self.targets, self.answers, self.tables, self.texts = [], [], [], []
        for kind, topic, keep in (
            (PoseWithCovarianceStamped, "landing/selected", self.targets),
            (PointCloud2, "landing/status", self.answers),
            (PointCloud2, "landing/site_table", self.tables),
            (DiagnosticStatus, "landing/status_text", self.texts),
        ):
            profile = QoSProfile(depth=50, durability=latched().durability)
            listener.node.create_subscription(kind, topic, keep.append, profile)

    def sees_the_east_alone(self):
        observed = self.cells.observed.copy()
        observed[:, : 2 * observed.shape[1] // 5] = False
        self.cells = dataclasses.replace(self.cells, observed=observed)

    def status(self):
        """Return the last record of the status."""
        return cloud_records(self.answers[-1], STATUS_FIELDS)[0] if self.answers else None

    def reasons(self):
        """Of all answers, each once."""
        records = [cloud_records(message, STATUS_FIELDS)[0] for message in self.answers]
        return {int(record["answer"]): Reason(int(record["reason"])) for record in records}

    def place(self):
        """Of the last target."""
        place = self.targets[-1].pose.pose.position
        return np.array([place.x, place.y, place.z])

    def has_target(self, answer=0):
        """True once a later answer than this gives one."""
        status = self.status()
        return status is not None and status["id"] > 0 and status["answer"] > answer


@pytest.fixture
def pilot(ros, cells):
    with ros.listen({}) as listener:
        pilot = Pilot(listener, cells)
        for topic in ("landing/area", "landing/keep_out"):  # else sites would wait for them
            pilot.send(topic, polygon([]))
        yield pilot


def test_the_target_is_withdrawn_with_its_reason_and_replaced(ros, pilot):
    ros.start("lss_node")
    stamp = pilot.send_map(0)
    pilot.until(pilot.has_target)
    first, before = pilot.place(), pilot.status()
    assert np.hypot(*(first[:2] - pilot.last()[2][0])) < 1e-3, "the first of the list"
    covariance = np.array(pilot.targets[-1].pose.covariance).reshape(6, 6)
    assert 0.0 < covariance[2, 2] < 0.1 and np.linalg.eigvalsh(covariance).min() >= 0.0
    assert before["hazard_distance"] > 0.0 and np.isfinite(before["offset_variance"])

    x, y = first[:2]
    about = [(x - 1, y - 1), (x + 1, y - 1), (x + 1, y + 1), (x - 1, y + 1)]
    pilot.send("landing/keep_out", polygon(about))
    pilot.until(pilot.has_target, before["answer"] + 1)
    assert np.hypot(*(pilot.place() - first)[:2]) > 2.0
    assert pilot.status()["id"] != before["id"]
    texts = [{item.key: item.value for item in text.values} for text in pilot.texts]
    assert {text["reason"] for text in texts} == {r.key for r in pilot.reasons().values()}
    assert pilot.texts[-1].level == DiagnosticStatus.OK and pilot.texts[-1].message
    assert float(texts[-1]["x"]) == pytest.approx(pilot.place()[0], abs=1e-3)
    # One map, one stamp, and every answer told apart.
    reasons = pilot.reasons()
    assert sorted(reasons) == list(range(1, max(reasons) + 1)), reasons
    assert list(reasons.values())[-2:] == [Reason.KEEP_OUT, Reason.FIRST], reasons
    assert {stamp_ns(message.header) for message in pilot.targets} == {stamp}
    empty = [np.isnan(message.pose.pose.position.x) for message in pilot.targets]
    assert any(empty) and not empty[-1]
    number = pilot.status()["answer"]
    pilot.until(lambda: (cloud_records(pilot.tables[-1], SITE_FIELDS)["answer"] == number).all())
    pilot.until(lambda: pilot.values().get("target.reason") in ("first", "holds"))


@pytest.mark.slow
def test_low_vehicle_commits(ros, pilot):
    """The map stays the same: without poses the target would only be held."""
    profile, make = stream(5, reliable=True), pilot.listener.node.create_publisher
    navigation = make(PoseWithCovarianceStamped, "nav/pose", profile)
    pilot.sees_the_east_alone()
    ros.start("lss_node", "-p", "lss.settle_time:=9.0")
    pilot.send_map(0)

    def is_in(state):
        return pilot.status() is not None and pilot.status()["state"] == state

    pilot.until(is_in, State.SETTLING)
    status = pilot.status()
    assert 0.5 < status["seen"] < 1.0 and not pilot.targets, "silent before it has decided"
    pilot.until(pilot.has_target)
    assert pilot.status()["state"] == State.HOLDS and 0.9 < pilot.status()["probability"] <= 1.0
    number = itertools.count(1)

    def low():
        place = (0.0, 0.0, pilot.place()[2] + 19.0)
        stamp, turn = next(number) * 10**8, (0.0, 0.0, 0.0, 1.0)
        navigation.publish(MAKE.pose(stamp, place, turn, np.zeros((6, 6))))
        pilot.send_map(next(number))
        return is_in(State.COMMITTED)

    pilot.until(low)


@pytest.mark.slow
def test_released_target_is_replaced(ros, pilot):
    ros.start("lss_node")
    assert not ros.call(pilot.listener, "/lss_node/release").success, "there is none"
    pilot.send_map(0)
    pilot.until(pilot.has_target)
    before = pilot.status()["answer"]
    answer = ros.call(pilot.listener, "/lss_node/release")
    assert answer.success and "1 is released: now target " in answer.message
    pilot.until(pilot.has_target, before)
    assert pilot.reasons()[before + 1] is Reason.RELEASED


def test_land_now_selects_before_inputs_settle(ros, pilot):
    ros.start("lss_node", "-p", "lss.settle_time:=900.0")
    pilot.sees_the_east_alone()
    pilot.send_map(0)
    pilot.until(lambda: pilot.status() is not None)
    assert pilot.status()["state"] == State.SETTLING
    answer = ros.call(pilot.listener, "/lss_node/land_now")
    assert answer.success and "probability" in answer.message, answer.message
    pilot.until(lambda: pilot.status()["state"] == State.NOW)
    status = pilot.status()
    assert status["reason"] == Reason.LAND_NOW
    assert status["now_probability"] == status["probability"] > 0.9
    pilot.until(lambda: pilot.targets)
    assert np.hypot(status["now_x"] - pilot.place()[0], status["now_y"] - pilot.place()[1]) < 1e-3
    assert ros.call(pilot.listener, "/lss_node/release").success
    pilot.until(lambda: pilot.status()["state"] == State.HOLDS)


@pytest.mark.slow
def test_deadline_reveals_a_dead_node_only(ros, pilot):
    missed, alive, heard = [], [], []
    callbacks = SubscriptionEventCallbacks(
        deadline=missed.append, liveliness=lambda event: alive.append(event.alive_count)
    )
    how = {"qos_profile": target(), "event_callbacks": callbacks}
    hear = pilot.listener.node.create_subscription
    hear(PoseWithCovarianceStamped, "landing/selected", heard.append, **how)
    lss = ros.start("lss_node")
    pilot.send_map(0)
    pilot.until(lambda: heard and pilot.has_target())
    count = len(heard)

    def in_time():
        """Seven times in a row, without a new map; a computer so loaded as to miss one goes on."""
        nonlocal count
        if missed:
            missed.clear()
            count = len(heard)
        return len(heard) > count + 7 and alive[-1] == 1

    pilot.until(in_time)
    lss.stop(signal.SIGKILL)
    pilot.until(lambda: missed and alive[-1] == 0)
