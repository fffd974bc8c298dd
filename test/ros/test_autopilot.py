# SPDX-License-Identifier: Apache-2.0
"""``autopilot_node`` as a process, with a model of an autopilot and a substitute for lss_node."""

import math
import os
import time

import numpy as np
import pytest
from autopilot_model import LOITER, Autopilot
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PolygonStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from ros_scene import MAKE
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from quadtree_lss.onboard.autopilot.link import ARDUPILOT, GUIDED_MODES, PX4
from quadtree_lss.onboard.core.landing.target import State
from quadtree_lss.onboard.messages.maps import STATUS_FIELDS
from quadtree_lss.onboard.nodes.qos import latched, stream, target
from quadtree_lss.onboard.nodes.ros_messages import time_message

pytestmark = pytest.mark.xdist_group("ros_autopilot")
FAST = {"gate_height": 5.0, "descent_speed": 1.5, "touchdown_speed": 0.5, "transit_speed": 4.0}


class Scene:
    """A model in the air, the node, and a substitute for lss_node that publishes in each step."""

    def __init__(self, ros, listener, model, remap=(), **parameters):
        self.model, self.listener = model, listener
        self.place, self.map_age, self.silent = (0.0, 0.0, 0.0), 0.2, False
        self.says = State.HOLDS
        self.states, self.odometry = [], []
        node = listener.node
        kind = PoseWithCovarianceStamped
        self._selected = node.create_publisher(kind, "landing/selected", target())
        self._status = node.create_publisher(PointCloud2, "landing/status", latched())
        node.create_subscription(DiagnosticStatus, "landing/autopilot", self._on_state, latched())
        every = QoSProfile(depth=50)
        node.create_subscription(Odometry, "nav/odometry", self.odometry.append, every)
        given = {"connection": model.connection, **FAST, **parameters}
        options = [o for k, v in given.items() for o in ("-p", f"autopilot.{k}:={v}")]
        options += [o for rule in remap for o in ("-r", rule)]
        if model.pace != 1.0:
            clock = node.create_publisher(Clock, "/clock", stream(10, reliable=True))
            began = time.time()

            def tell():
                now = began + model.pace * (time.time() - began)
                clock.publish(Clock(clock=time_message(round(1e9 * now))))

            node.create_timer(0.01, tell)
            options += ["-p", "use_sim_time:=true"]
        self.node = ros.start("autopilot_node", *options)
        node.create_timer(0.1, self._say)

    def _on_state(self, message):
        state = {item.key: item.value for item in message.values}["state"]
        if not self.states or self.states[-1] != state:
            self.states.append(state)

    def _say(self):
        if self.silent:
            return
        stamp = time.time_ns()
        record = np.zeros(1, dtype=STATUS_FIELDS)
        record["age"], record["offset_z"] = self.map_age, math.nan
        record["state"] = self.says
        turn = (0.0, 0.0, 0.0, 1.0)
        self._selected.publish(MAKE.pose(stamp, self.place, turn, np.zeros((6, 6))))
        self._status.publish(MAKE.cloud(record, stamp))

    def wait(self, condition, seconds=40.0):
        came = self.listener.wait_for(condition, timeout=seconds)
        model, said = self.model, self.node.output()
        assert came, f"{self.states} at {model.enu}, {model.texts}\n{said}"
        return self

    def handed_over(self):
        """Switch the mode as the pilot, until it is accepted."""
        kind = self.model.kind
        self.wait(lambda: self.odometry and self.states)
        self.wait(
            lambda: self.model.mode == GUIDED_MODES[kind] or self.model.switch(GUIDED_MODES[kind])
        )
        return self

    def until(self, state):
        return self.wait(lambda: self.states and self.states[-1] == state)

    def below(self, height):
        return self.wait(lambda: self.model.enu[2] < height)

    def flies_up_and_stays(self):
        """Check that the vehicle climbs to the gate without ground contact."""
        self.wait(lambda: self.model.enu[2] > FAST["gate_height"] - 1.0)
        assert self.model.landed_at is None


@pytest.fixture
def scene(ros):
    ends = []

    def make(kind=ARDUPILOT, place=(4.0, -3.0, 7.0), pace=1.0, **parameters):
        listener = ros.listen({})
        ends.append(listener.__exit__)
        model = Autopilot(kind, place, pace=pace)
        ends.append(model.__exit__)
        model.__enter__()
        listener.__enter__()
        return Scene(ros, listener, model, **parameters)

    yield make
    for end in reversed(ends):
        end()


@pytest.mark.quick("3")
@pytest.mark.parametrize("kind", [ARDUPILOT, PX4])
def test_landing_at_the_target_with_outputs(ros, scene, kind):
    heard = {}
    flight = scene(kind, may_command="arming")
    node = flight.listener.node
    keep = heard.__setitem__
    for topic, cls in (
        ("landing/area", PolygonStamped),
        ("landing/dispersion", PoseWithCovarianceStamped),
    ):
        node.create_subscription(cls, topic, lambda m, topic=topic: keep(topic, m), latched())
    flight.wait(lambda: flight.odometry)
    # As poses say, by this computer's clock: no adapter in between.
    last = flight.odometry[-1]
    place = last.pose.pose.position
    np.testing.assert_allclose([place.x, place.y, place.z], flight.model.enu, atol=0.05)
    assert abs(last.header.stamp.sec - time.time()) < 3.0
    assert last.header.frame_id == "map" and last.child_frame_id == "base_link"
    variances = np.diag(np.reshape(last.pose.covariance, (6, 6)))
    assert (variances > 0.0).all()
    if kind == PX4:
        np.testing.assert_allclose(variances[:3], [0.02, 0.01, 0.03], rtol=1e-5)
        # Without a pose there is no place to stream, and so no offboard.
        flight.wait(lambda: flight.model.points).model.frozen = True
        flight.wait(lambda: flight.model._now - flight.model.points[-1][0] > 0.7)
        flight.model.frozen = False
    answer = ros.call(flight.listener, "/autopilot_node/land")
    assert answer.success, answer.message
    flight.handed_over().model.deaf = 1
    flight.until("touchdown").wait(lambda: not flight.model.armed)  # what is lost is said again
    assert np.hypot(*flight.model.landed_at[:2]) < 0.1 and flight.model.left_offboard == 0
    # On a loaded computer it may have held on the way.
    assert "transit" in flight.states and flight.states[-3:] == ["descend", "commit", "touchdown"]
    corners = np.array([(p.x, p.y) for p in heard["landing/area"].polygon.points])
    np.testing.assert_allclose(np.hypot(*(corners - (4.0, -3.0)).T), 50.0, atol=0.5)
    sigma = math.sqrt(heard["landing/dispersion"].pose.covariance[0])
    assert sigma == pytest.approx(math.hypot(0.1, math.sqrt(variances[0])), abs=1e-3)
    flight.model.cut = True  # what is asked for now, nobody hears
    flight.wait(lambda: not ros.call(flight.listener, "/autopilot_node/land").success, 10.0)


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["lss_node killed", "old map"])
def test_target_faults_during_the_descent(scene, fault):
    """Test the faults that depend on the node's clock; others are in autopilot/test_landing.py."""
    flight = scene().handed_over().below(2.5)
    if fault == "old map":
        flight.map_age = 9.0
    else:
        flight.silent = True
    flight.until("wave_off").flies_up_and_stays()
    flight.until("hold")
    targets = len(flight.model.targets)
    flight.listener.wait_for(lambda: False, timeout=1.5)
    assert len(flight.model.targets) == targets, "precision landing hears of it no more"
    flight.place, flight.silent, flight.map_age = (1.0, 1.0, 0.0), False, 0.2
    flight.until("touchdown")
    assert np.hypot(*(flight.model.landed_at - (1.0, 1.0, 0.0))[:2]) < 0.1


@pytest.mark.slow
def test_land_now_accepts_an_old_map(scene):
    flight = scene().handed_over().below(3.0)
    flight.says, flight.map_age = State.NOW, 9.0
    flight.until("touchdown")
    assert "wave_off" not in flight.states and np.hypot(*flight.model.landed_at[:2]) < 0.1


@pytest.mark.slow
def test_mode_change_and_navigation_jump(scene):
    flight = scene().handed_over().below(3.5)
    model = flight.model
    model.switch(LOITER)
    flight.until("pilot")
    flight.listener.wait_for(lambda: False, timeout=0.3)
    points = len(model.points)
    flight.listener.wait_for(lambda: False, timeout=1.0)
    assert len(model.points) == points and model.enu[2] > 1.5
    flight.handed_over().until("descend")
    model.shift[:] = 3.0, 0.0, 0.0
    flight.until("give_up")
    flight.wait(lambda: any("jumped" in text for text in model.texts))
    assert model.landed_at is None


@pytest.mark.slow
def test_ages_use_simulated_time(scene):
    """In a simulator at a quarter of real time, a silence of 1.5 s is less than half a second."""
    flight = scene(place=(0.0, 0.0, 5.5), pace=0.25)
    flight.handed_over().below(4.0)
    flight.silent = True
    flight.listener.wait_for(lambda: False, timeout=1.5)
    assert flight.states[-1] == "descend"
    flight.until("wave_off").flies_up_and_stays()


@pytest.mark.slow
def test_hostile_targets_do_not_lower_the_vehicle(scene):
    """Send invalid places and random statuses at 1000 Hz; HOSTILE sets the number."""
    flight, rng = scene(place=(0.0, 0.0, 4.5)), np.random.default_rng(1)
    flight.handed_over().below(3.5).silent = True
    flight.until("wave_off").until("hold")
    flight.model.lowest, height = np.inf, flight.model.enu[2]
    for _ in range(int(os.environ.get("HOSTILE", "1000"))):
        place = rng.choice([math.nan, math.inf, -1e300, 1e9, 3.0], 3)
        place[rng.integers(3)] = rng.choice([math.nan, math.inf, 1e30])
        turn = rng.choice([0.0, 1.0, math.nan], 4)
        selected = MAKE.pose(int(rng.integers(2**62)), place, turn, np.full((6, 6), place[0]))
        selected.header.frame_id = str(rng.choice(["map", "", "odom", "x" * 300]))
        record = np.frombuffer(rng.bytes(STATUS_FIELDS.itemsize), STATUS_FIELDS)
        status = MAKE.cloud(record.repeat(int(rng.integers(0, 3))), 0)
        status.point_step = int(rng.choice([status.point_step, 0, 1, 2**31]))
        flight._selected.publish(selected)
        flight._status.publish(status)
        flight.listener.wait_for(lambda: False, timeout=0.001)
    told = len(flight.node.output())
    assert flight.model.lowest > height - 0.5 and flight.states[-1] in ("hold", "give_up")
    assert flight.node.process.poll() is None and told < 200_000


@pytest.mark.slow
def test_two_target_publishers_and_a_node_without_autopilot(ros, scene):
    flight = scene(place=(0.0, 0.0, 4.5))
    node = flight.listener.node
    other = node.create_publisher(PoseWithCovarianceStamped, "landing/selected", target())
    flight.handed_over().until("wait")
    flight.listener.wait_for(lambda: False, timeout=1.0)
    assert flight.states[-1] == "wait" and "2 publishers" in flight.node.output()
    flight.listener.forget(other)
    flight.until("touchdown")
    answer = ros.call(flight.listener, "/autopilot_node/land")
    assert not answer.success and "may_command" in answer.message


@pytest.mark.slow
def test_px4_armed_on_the_ground_stays_there(scene):
    """Include the time before the first landed state."""
    flight = scene(PX4, place=(0.0, 0.0, 0.0))
    flight.model.deaf = 1  # so that it is to be asked again
    flight.handed_over().wait(lambda: 245 in flight.model._rates)
    flight.listener.wait_for(lambda: False, timeout=1.0)
    assert flight.states == ["pilot"] and flight.model.enu[2] < 0.1, flight.node.output()
