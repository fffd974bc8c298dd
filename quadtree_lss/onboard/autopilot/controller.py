# SPDX-License-Identifier: Apache-2.0
"""Flies the landing over a link: messages in, one decision at a time, set-points out."""

from __future__ import annotations

import time
from collections.abc import Callable

from quadtree_lss.onboard.autopilot.frames import Jumps, Nav
from quadtree_lss.onboard.autopilot.landing import HEARTBEAT_S, PILOT, Landing, Order
from quadtree_lss.onboard.autopilot.link import PX4, Link
from quadtree_lss.onboard.autopilot.seen import POSE_S, Seen, Target
from quadtree_lss.onboard.config.sections import AutopilotConfig


class Controller:
    """Connects `Link` and `Landing`.

    Attributes:
        nav: The newest pose; None before the first.
        lack: What a landing takes and has not come yet of the autopilot; empty afterwards.
    """

    def __init__(
        self,
        config: AutopilotConfig,
        clock: Callable[[], int],
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.config = config
        self.link = Link(config.connection, clock, now)
        self.landing = Landing(config)
        self.nav: Nav | None = None
        self._jumps, self._jump = Jumps(), 0.0
        self._clock, self._now = clock, now
        self._was_landed_told = False

    def configure(self, config: AutopilotConfig) -> None:
        """Other limits, speeds and permissions; the connection stays."""
        self.config = config
        self.landing.configure(config)

    @property
    def lack(self) -> str:
        if self.link.kind is None:
            return f"the heartbeat of an autopilot on {self.config.connection}"
        if self.nav is None:
            return "a pose of the autopilot"
        self._was_landed_told |= self.link.landed is not None
        if not self._was_landed_told:
            return "EXTENDED_SYS_STATE of the autopilot: whether it is on the ground"
        return ""

    def poll(self) -> list[Nav]:
        """Take what has come and say what is due; return new poses, oldest first."""
        navs = self.link.poll()
        for nav in navs:
            self._jump = max(self._jump, self._jumps.size(nav))
            self.nav = nav
        return navs

    def step(self, target: Target | None, why: str) -> Order | None:
        """Decide, and send what follows from it; None while something lacks. ``why``: there is no
        target."""
        if self.lack or self.nav is None:
            return None
        link, nav = self.link, self.nav
        age = abs(1e-9 * (self._clock() - nav.stamp_ns))
        now = self._now()
        seen = Seen(
            now, link.follows, link.armed, link.landed, link.landed_for, now - link.heard, age,
            nav.position, nav.velocity, self._jump, target, why,
        )  # fmt: skip
        self._jump = 0.0
        order = self.landing.step(seen)
        point = order.point
        if link.kind == PX4 and order.state == PILOT:
            fresh = seen.heartbeat_age <= HEARTBEAT_S and age <= POSE_S
            point = self.landing.stay(seen) if fresh else None
        if point is not None:
            link.fly_to(point, order.sink)
        if order.target is not None:
            link.show_target(order.target.place, nav)
        if order.settles and self.config.may_command != "nothing":
            link.settle(disarm=self.config.may_command == "arming")
        return order
