# SPDX-License-Identifier: Apache-2.0
"""Connection of the MAVLink link with the state machine of the landing."""

from __future__ import annotations

from collections.abc import Callable

from quadtree_lss.onboard.autopilot.frames import JumpDetector, Nav
from quadtree_lss.onboard.autopilot.inputs import POSE_S, Inputs, Target
from quadtree_lss.onboard.autopilot.landing import HEARTBEAT_S, PILOT, Landing, Order
from quadtree_lss.onboard.autopilot.link import PX4, Link
from quadtree_lss.onboard.config.sections import AutopilotConfig


class Controller:
    """Connect `Link` and `Landing`; arguments as of `Link`. ``nav``: the newest pose."""

    def __init__(
        self, config: AutopilotConfig, clock: Callable[[], int], now: Callable[[], float]
    ) -> None:
        self.config = config
        self.link = Link(config.connection, clock, now)
        self.landing = Landing(config)
        self.nav: Nav | None = None
        self._jumps, self._jump = JumpDetector(), 0.0
        self._clock, self._now = clock, now
        self._landed_received = False

    def configure(self, config: AutopilotConfig) -> None:
        """Set new limits, speeds and permissions; the connection does not change."""
        self.config = config
        self.landing.configure(config)

    @property
    def missing(self) -> str:
        """The first input from the autopilot that has not arrived yet; empty if none is missing."""
        if self.link.kind is None:
            return f"the heartbeat of an autopilot on {self.config.connection}"
        if self.nav is None:
            return "a pose of the autopilot"
        self._landed_received |= self.link.landed is not None
        if not self._landed_received:
            return "EXTENDED_SYS_STATE of the autopilot (on the ground or in the air)"
        return ""

    def poll(self) -> list[Nav]:
        """Handle received messages and send the periodic ones; return new poses, oldest first."""
        navs = self.link.poll()
        for nav in navs:
            self._jump = max(self._jump, self._jumps.jump(nav))
            self.nav = nav
        return navs

    def step(self, target: Target | None, why: str) -> Order | None:
        """Run one step of the landing and send its commands; return None while an input is missing.
        ``why``: the reason why ``target`` is None."""
        if self.missing or self.nav is None:
            return None
        link, nav = self.link, self.nav
        age = abs(1e-9 * (self._clock() - nav.stamp_ns))
        now = self._now()
        inputs = Inputs(
            now, link.accepts_set_points, link.armed, link.landed, link.landed_for,
            now - link.last_heartbeat, age, nav.position, nav.velocity, self._jump, target, why,
        )  # fmt: skip
        self._jump = 0.0
        order = self.landing.step(inputs)
        point = order.point
        if link.kind == PX4 and order.state == PILOT:
            fresh = inputs.heartbeat_age <= HEARTBEAT_S and age <= POSE_S
            point = self.landing.idle_set_point(inputs) if fresh else None
        if point is not None:
            link.send_set_point(point, order.sink)
        if order.target is not None:
            link.send_landing_target(order.target.place, nav)
        if order.may_stop_motors and self.config.may_command != "nothing":
            link.stop_motors(disarm=self.config.may_command == "arming")
        return order
