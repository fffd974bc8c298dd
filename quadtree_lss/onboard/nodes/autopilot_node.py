# SPDX-License-Identifier: Apache-2.0
"""Node that lands with a MAVLink autopilot; `onboard.autopilot` computes the set-points."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point32, PolygonStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.publisher import Publisher
from sensor_msgs.msg import PointCloud2

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.autopilot import landing
from quadtree_lss.onboard.autopilot.controller import Controller
from quadtree_lss.onboard.autopilot.frames import Nav
from quadtree_lss.onboard.autopilot.inputs import Target, target_from_status
from quadtree_lss.onboard.autopilot.link import PX4
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.geometry.rotations import rotation_from_quaternion
from quadtree_lss.onboard.errors import QuadtreeLssError
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.outputs import SELECTED, STATUS, status_from_message
from quadtree_lss.onboard.messages.poses import check_frame
from quadtree_lss.onboard.nodes.diagnostics import ERROR, OK, WARN, Status
from quadtree_lss.onboard.nodes.entry import set_waiting_for
from quadtree_lss.onboard.nodes.losses import Publishers
from quadtree_lss.onboard.nodes.node_runner import BaseNode, run
from quadtree_lss.onboard.nodes.qos import (
    advertise,
    latched,
    serve,
    steady_timer,
    stream,
    subscribe,
)
from quadtree_lss.onboard.nodes.ros_messages import header_message, message_maker

ODOMETRY, AREA, DISPERSION = "nav/odometry", "landing/area", "landing/dispersion"
STATE = "landing/autopilot"
POLL_S, STEP_S = 0.01, 0.1
CONNECT_S = 0.3
"""Timeout of a TCP connection, whose default of two minutes would block the node."""
CORNERS = 24
"""Corners of the polygon for the circle of ``autopilot.reach``."""
CONTROL_M = 0.1
"""Standard deviation of the autopilot's control: 251 landings with ArduCopter were at most 0.13 m
from the target (``docs/evidence.md``)."""
LEVELS = {landing.GIVE_UP: ERROR, landing.WAVE_OFF: WARN, landing.HOLD: WARN}


class AutopilotNode(BaseNode):
    """Land the vehicle, as described in ``docs/autopilot.md``."""

    def __init__(self) -> None:
        super().__init__("autopilot_node")
        config = self._config
        link = config.autopilot
        self._now: Callable[[], float] = time.monotonic
        if self.get_parameter("use_sim_time").value:  # a simulator may run slower than real time
            self._now = lambda: 1e-9 * self._clock_ns()
        self._controller = Controller(link, self._clock_ns, self._now)
        self._link = self._controller.link
        self._order = landing.Order(landing.PILOT, "no heartbeat yet", None, None)
        self._selected: tuple[float, Array] | None = None
        self._status: tuple[float, Any] | None = None
        effect = "the vehicle flies to no target while there is more than one"
        self._sources = {
            topic: Publishers(self.resolve_topic_name(topic), reason, effect, self._problems)
            for topic, reason in ((SELECTED, "target_publishers"), (STATUS, "status_publishers"))
        }
        kind, matched = PoseWithCovarianceStamped, self._sources[SELECTED].changed
        subscribe(self, kind, SELECTED, self._on_selected, latched(), matched)
        matched = self._sources[STATUS].changed
        subscribe(self, PointCloud2, STATUS, self._on_status, latched(), matched)
        if link.odometry:
            self._odometry = advertise(self, Odometry, ODOMETRY, stream(50, reliable=True))
        self._area = advertise(self, PolygonStamped, AREA, latched())
        self._dispersion = advertise(self, PoseWithCovarianceStamped, DISPERSION, latched())
        self._state = advertise(self, DiagnosticStatus, STATE, latched())
        serve(self, "land", self._on_land)
        steady_timer(self, POLL_S, self._poll)
        if self._now is time.monotonic:
            steady_timer(self, STEP_S, self._step)
        else:
            self.create_timer(STEP_S, self._step)
        self._announce()
        if config.lss.commit_height < link.gate_height:
            text = "lss.commit_height is below autopilot.gate_height"
            self.get_logger().warning(f"{text}: a better target during the descent is a wave-off")

    def _clock_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def destroy_node(self) -> None:
        """Close the connection and destroy the node."""
        self._link.close()
        super().destroy_node()

    def _reconfigure(self, config: Config) -> None:
        self._controller.configure(config.autopilot)

    def _on_selected(self, message: Any) -> None:
        place = message.pose.pose.position
        try:
            check_frame(message.header.frame_id, self._frame, SELECTED)
        except MessageError as error:
            self._problems.report("target_frame", f"{error}: ignored")
            return
        self._selected = (self._now(), np.array([place.x, place.y, place.z]))

    def _on_status(self, message: Any) -> None:
        try:
            self._status = (self._now(), status_from_message(message))
        except MessageError as error:
            self._problems.report("status_layout", str(error))

    def _target(self, now: float) -> tuple[Target | None, str]:
        """Return the target of lss_node, else the reason why there is none."""
        if self._selected is None or self._status is None:
            return None, "no message from lss_node yet"
        for topic, sources in self._sources.items():
            if sources.number > 1:
                return None, f"{sources.number} nodes publish {topic}"
        (selected_time, place), (status_time, status) = self._selected, self._status
        age = now - min(selected_time, status_time)
        return target_from_status(place, status, age, now - status_time)

    def _poll(self) -> None:
        for nav in self._controller.poll():
            if self._config.autopilot.odometry:
                self._odometry.publish(self._odometry_message(nav))

    def _odometry_message(self, nav: Nav) -> Odometry:
        frames, pose = self._config.frames, self._config.pose
        message = Odometry(header=header_message(nav.stamp_ns, frames.map))
        message.child_frame_id = frames.body or "base_link"
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        place.x, place.y, place.z = nav.position.tolist()
        turn.x, turn.y, turn.z, turn.w = nav.quaternion.tolist()
        sigmas = [pose.unknown_position_sigma, math.radians(pose.unknown_attitude_sigma_deg)]
        unknown = np.diag(np.repeat(np.square(sigmas), 3))
        covariance = unknown if nav.covariance is None else nav.covariance
        message.pose.covariance = covariance.ravel()
        linear = message.twist.twist.linear
        velocity = rotation_from_quaternion(nav.quaternion).T @ nav.velocity  # in body axes
        linear.x, linear.y, linear.z = velocity.tolist()
        return message

    def _step(self) -> None:
        self._poll()  # detect a mode change by the pilot before the next set-point
        set_waiting_for(missing := self._missing_inputs())
        previous_state = self._controller.landing.state
        order = self._controller.step(*self._target(self._now()))
        if order is None or self._controller.nav is None:
            self._publish_state(landing.Order(landing.PILOT, f"waiting for {missing}", None, None))
            return
        if order.state != previous_state:
            self._on_change(order, self._controller.nav)
        self._publish_state(order)

    def _missing_inputs(self) -> str:
        """Return the inputs of a landing that have not arrived yet; empty if none is missing."""
        if missing := self._controller.missing:
            return missing
        if self._selected is None or self._status is None:
            known = self._sources[SELECTED].number
            return f"{SELECTED} and {STATUS} (publishers known: {known})"
        return ""

    def _on_change(self, order: landing.Order, nav: Nav) -> None:
        """Report a new state to the log, the pilot and lss_node."""
        warn, text = order.state in LEVELS, f"{order.state}: {order.text}"
        if warn:  # each call keeps its severity
            self.get_logger().warning(text)
        else:
            self.get_logger().info(text)
        self._link.send_text(f"lss {text}", warn=warn)
        if order.point is not None:
            if self._is_only_publisher(self._dispersion):
                self._send_dispersion(nav)
            if self._order.state == landing.PILOT and self._is_only_publisher(self._area):
                self._send_reach(nav)

    def _is_only_publisher(self, publisher: Publisher) -> bool:
        """Return whether no other node, such as guidance, publishes the topic."""
        return bool(self.count_publishers(publisher.topic_name) <= 1)

    def _send_reach(self, nav: Nav) -> None:
        message = PolygonStamped(header=header_message(nav.stamp_ns, self._frame))
        angle = np.linspace(0.0, 2.0 * np.pi, CORNERS, endpoint=False)
        reach = self._config.autopilot.reach
        corners = nav.position[:2, None] + reach * np.array([np.cos(angle), np.sin(angle)])
        message.polygon.points = [Point32(x=float(x), y=float(y)) for x, y in corners.T]
        self._area.publish(message)

    def _send_dispersion(self, nav: Nav) -> None:
        sigma = self._config.pose.unknown_position_sigma
        variance = np.full(2, sigma**2)
        if nav.covariance is not None:
            variance = nav.covariance.diagonal()[:2]
        covariance = np.diag([*(variance + CONTROL_M**2), 0.0, 0.0, 0.0, np.pi**2])
        make, level = message_maker(self._frame), (0.0, 0.0, 0.0, 1.0)
        self._dispersion.publish(make.pose(nav.stamp_ns, np.zeros(3), level, covariance.ravel()))

    @property
    def _frame(self) -> str:
        return self._config.frames.map

    def _publish_state(self, order: landing.Order) -> None:
        self._order = order
        status = DiagnosticStatus(level=LEVELS.get(order.state, OK), name="landing")
        status.message = f"{order.state}: {order.text}"
        values: dict[str, object] = {"state": order.state, "text": order.text}
        values["wave_offs"] = self._controller.landing.wave_offs
        if (nav := self._controller.nav) is not None:
            x, y, z = nav.position
            values |= {"x": f"{x:.3f}", "y": f"{y:.3f}", "z": f"{z:.3f}"}
            if order.target is not None:
                height = nav.position[2] - order.target.place[2]
                offset = np.hypot(*(nav.position - order.target.place)[:2])
                values |= {"height": f"{height:.2f}", "offset": f"{offset:.2f}"}
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        self._state.publish(status)

    def _on_land(self) -> str:
        fault = ""
        if self._now() - self._link.last_heartbeat > landing.HEARTBEAT_S:
            fault = "no heartbeat"
        if self._config.autopilot.may_command == "nothing":
            fault = "autopilot.may_command is nothing"
        if fault:
            msg = f"{fault}: the pilot switches to guided or offboard"
            raise QuadtreeLssError(msg)
        self._link.request_guided_mode()
        return "requested the mode that follows set-points"

    def _collect(self, status: Status) -> None:
        status.note(LEVELS.get(self._order.state, OK), f"{self._order.state}: {self._order.text}")
        if missing := self._missing_inputs():
            status.note(WARN, f"waiting for {missing}")
        heartbeat_age = self._now() - self._link.last_heartbeat
        status.add({"autopilot.kind": {None: "none", PX4: "px4"}.get(self._link.kind, "ardupilot")})
        status.add({"heartbeat.age_s": heartbeat_age})
        status.add({"target.publishers": self._sources[SELECTED].number})
        status.add({f"autopilot.heard.{what}": n for what, n in self._link.message_counts.items()})
        status.add({f"autopilot.refused.{why}": n for why, n in self._link.rejected.items()})
        if heartbeat_age > landing.HEARTBEAT_S:
            connection = self._config.autopilot.connection
            status.note(ERROR, f"no heartbeat of an autopilot on {connection}")
        elif self._now() - self._link.last_answer > landing.HEARTBEAT_S:
            text = "the autopilot sends but does not answer: check that it receives this computer"
            status.note(WARN, text)
        if (uncertainty := self._link.remote.uncertainty_ns) is not None:
            status.add({"clock.uncertainty_ms": 1e-6 * uncertainty})


def main(args: Sequence[str] | None = None) -> int:
    """Console script ``autopilot_node``."""
    socket.setdefaulttimeout(CONNECT_S)
    return run(AutopilotNode, "autopilot_node: lands at the target with a MAVLink autopilot", args)
