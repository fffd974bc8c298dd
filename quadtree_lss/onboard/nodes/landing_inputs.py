# SPDX-License-Identifier: Apache-2.0
"""What guidance says: ``landing/area``, ``keep_out``, ``target`` and ``dispersion``."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped, PolygonStamped, PoseWithCovarianceStamped
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.timer import Timer

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.landing_inputs import (
    BINDING,
    DECODE,
)
from quadtree_lss.onboard.nodes.problems import Problems
from quadtree_lss.onboard.nodes.qos import latched, stream, subscribe

JOIN_S = 3.0
"""How long after the node has come it may well not know another, whose latched messages are waiting
for it: nodes announce themselves at their start and then every three seconds. Some of that may be
lost, so where a site in a keep-out would be a disaster, ``lss.required_input`` is to be set.
"""

SETTLE_S = 1.0
"""How long after the first map latched messages may be on their way from whoever came with it."""

UNHEARD_S = 3.5
"""The same while a latched publisher is there from which nothing came: the middleware repeats what
was lost after three seconds, and the publisher may have nothing to say."""

QUIET_S = 0.2
"""A publisher may have kept more than its last message: they come at once, oldest first."""

LOOK_S = 0.05


class _Input:
    """One topic: what came last, and what it says in the map's frame.

    Attributes:
        message: The last one, None before the first.
        value: What holds, None if nothing was asked for or the last message cannot be used.
        unusable: Why the last message cannot be used, empty if it can.
    """

    def __init__(self, name: str, decode: Callable[[Any, str], Array | None]) -> None:
        self.name = name
        self.message: Any = None
        self.value: Array | None = None
        self.unusable = ""
        self._decode = decode
        self._sample = (0, 0)

    def take(self, message: Any, info: dict[str, int]) -> bool:
        """Hold this message; False if it is the one that is held, come by the other way."""
        sample = (info["source_timestamp"], info["publication_sequence_number"])
        if sample == self._sample and sample[0] > 0:  # 0 where the middleware does not say
            return False
        self.message, self._sample = message, sample
        return True

    def decode(self, frame: str | None) -> Array | None:
        """What the message that is held says; any frame will do while the map's is None.

        Raises:
            MessageError: it cannot be used.
        """
        own = self.message.header.frame_id
        return self._decode(self.message, own if frame is None else frame)


class LandingInputs:
    """Subscribes to the topics and judges what came last by the map's frame.

    Each is subscribed to twice: latched, to get back after a restart what was sent before, and
    volatile, which matches publishers that keep nothing. Both ways end with the newest message.

    An area or a keep-out that was sent and cannot be used could be anywhere: no site may be given
    out then. Of a target that cannot be used the one before it holds; it only makes sites better.

    Args:
        node: Owner.
        problems: Where unusable messages are told.
        changed: Called after each change, and when `settled` has become true.
        required: ``lss.required_input``: those without which `settled` stays false.
    """

    def __init__(
        self, node: Node, problems: Problems, changed: Callable[[], None], required: str
    ) -> None:
        self._required = BINDING if required == "both" else (required,)
        self._node, self._problems, self._changed = node, problems, changed
        self._frame: str | None = None
        self._joined = self._heard = time.monotonic()
        self._began: float | None = None
        self._timer: Timer | None = None
        self._settled = False
        self._inputs: dict[str, _Input] = {}
        self._latched: dict[str, Any] = {}
        for name, kind in (
            ("area", PolygonStamped),
            ("keep_out", PolygonStamped),
            ("target", PointStamped),
            ("dispersion", PoseWithCovarianceStamped),
        ):
            given = self._inputs[name] = _Input(name, DECODE[name])
            take = self._taker(given)
            subscribe(node, kind, f"landing/{name}", take, stream(5, reliable=True))
            quiet = SubscriptionEventCallbacks(use_default_callbacks=False)
            self._latched[name] = node.create_subscription(
                kind, f"landing/{name}", take, latched(), event_callbacks=quiet
            )

    def restrictions(self) -> dict[str, Any]:
        """Keyword arguments of ``LandingSiteSelector.assess``."""
        values = {name: given.value for name, given in self._inputs.items()}
        return {**values, "withheld": self.withheld}

    @property
    def withheld(self) -> str:
        """Why no site may be given out, empty if nothing speaks against it."""
        texts = (self._inputs[name].unusable for name in BINDING)
        return "; ".join(text for text in texts if text)

    def states(self) -> dict[str, object]:
        """Whether each is set, for the diagnostics."""
        return {
            name: "unusable" if given.unusable else given.value is not None
            for name, given in self._inputs.items()
        }

    def use_frame(self, frame: str) -> None:
        """The map is in this frame: what is held counts for it or does not, whenever it came."""
        if frame == self._frame:
            return
        self._frame = frame
        for given in self._inputs.values():
            given.value = None
            if given.message is not None:
                self._judge(given)

    def settled(self) -> bool:
        """True once both area and keep-out have come, or have had the time to and need not come.

        Until then nobody knows where landing is wanted. Call it first with the first map.
        """
        if self._settled:
            return True
        now = time.monotonic()
        if self._began is None:
            self._began = now
            clock = Clock(clock_type=ClockType.STEADY_TIME)
            self._timer = self._node.create_timer(LOOK_S, self._look, clock=clock)
        unheard = self.unheard()
        if any(name in self._required for name in unheard):
            return False
        expected = any(self._latched[name].get_publisher_count() for name in unheard)
        time_out = self._began + (UNHEARD_S if expected else SETTLE_S)
        in_time = now >= max(self._joined + JOIN_S, time_out)
        complete = not unheard and now >= self._heard + QUIET_S
        self._settled = in_time or complete
        return self._settled

    def unheard(self) -> list[str]:
        """Which of area and keep-out have not come."""
        return [name for name in BINDING if self._inputs[name].message is None]

    def _look(self) -> None:
        """Whoever asked in vain is told, whoever else may have asked in between."""
        if self.settled() and self._timer is not None:
            self._timer.cancel()
            self._changed()

    def _taker(self, given: _Input) -> Any:
        def take(message: Any, info: dict[str, int]) -> None:
            if not given.take(message, info):
                return
            self._heard = time.monotonic()
            value, unusable = given.value, given.unusable
            self._judge(given, new=True)
            if given.unusable != unusable or not np.array_equal(given.value, value):
                self._changed()

        return take

    def _judge(self, given: _Input, *, new: bool = False) -> None:
        """Decode what is held; a new message that cannot be used, or a new reason, is told."""
        told = "" if new else given.unusable
        given.unusable = ""
        try:
            given.value = given.decode(self._frame)
        except MessageError as error:
            given.unusable = f"landing/{given.name} cannot be used: {error}"
            effect = "what was set before holds"
            if given.name in BINDING:
                given.value = None
                effect = "no site is given out until one comes that can"
            if given.unusable != told:
                reason = f"{given.name}_{error.reason}"
                self._problems.report(reason, f"{given.unusable}; {effect}")
