# SPDX-License-Identifier: Apache-2.0
"""Subscriptions to the landing inputs: area, keep-outs, target and dispersion."""

from __future__ import annotations

import functools
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.timer import Timer

from quadtree_lss.onboard.messages import landing_inputs as inputs
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.nodes.diagnostics import Problems
from quadtree_lss.onboard.nodes.qos import steady_timer, subscribe_any_durability
from quadtree_lss.onboard.nodes.ros_messages import TYPES

JOIN_S = 3.0
"""Time in which the node discovers publishers of latched messages: nodes announce themselves every
three seconds. A vehicle that needs a keep-out sets ``lss.required_input``."""

SETTLE_S = 1.0
"""Time after the first map in which latched messages from the same computer arrive."""

UNHEARD_S = 3.5
"""The same while nothing came from a known publisher: the middleware repeats lost messages after
three seconds, but the publisher may not have sent any."""

QUIET_S = 0.2
"""Time without a message after which the latched messages of a publisher are complete."""

CHECK_S = 0.05
"""Period of checking whether the inputs are settled."""


class LandingTopics:
    """Subscriptions to the landing inputs, with their last messages as `LandingRequests`. Calls
    ``changed`` after each change, and when `settled` becomes true, which requires the inputs
    ``required`` (``lss.required_input``)."""

    def __init__(
        self, node: Node, problems: Problems, changed: Callable[[], None], required: str
    ) -> None:
        self.requests = inputs.LandingRequests(None)
        self._required = (inputs.AREA, inputs.KEEP_OUT) if required == "both" else (required,)
        self._node, self._problems, self._changed = node, problems, changed
        self._joined = self._heard = time.monotonic()
        self._began: float | None = None
        self._timer: Timer | None = None
        self._settled = False
        self._samples: dict[str, deque[tuple[int, int]]] = {}
        self._latched: dict[str, Any] = {}
        for name, kind in inputs.TYPES.items():
            take = functools.partial(self._take, name)
            kind, topic = TYPES[kind], f"landing/{name}"
            kept = inputs.MAX_KEEP_OUTS if name == inputs.KEEP_OUTS else 1
            self._samples[name] = deque(maxlen=2 * kept)
            self._latched[name] = subscribe_any_durability(node, kind, topic, take, kept)

    def states(self) -> dict[str, object]:
        """Return for each topic True if it is set, False, or "unusable", for the diagnostics."""
        values = self.requests.values
        unusable = {inputs.topic_of(name) for name in self.requests.unusable}
        held = {inputs.topic_of(name) for name, value in values.items() if value is not None}
        return {name: "unusable" if name in unusable else name in held for name in inputs.TYPES}

    def use_frame(self, frame: str) -> None:
        """Check all messages against the frame of the map."""
        before = dict(self.requests.unusable)
        for name, error in self.requests.use_frame(frame).items():
            if self.requests.unusable.get(name) != before.get(name):
                self._report(name, error)

    def settled(self) -> bool:
        """Return whether area and keep-out came, or had time to come and are not required. The time
        starts with the first call, at the first map."""
        if self._settled:
            return True
        now = time.monotonic()
        if self._began is None:
            self._began = now
            self._timer = steady_timer(self._node, CHECK_S, self._check)
        unheard = self.unheard()
        if any(name in self._required for name in unheard):
            return False
        heard = {inputs.topic_of(name) for name in self.requests.last_messages}
        published = {name for name in inputs.BINDING if self._latched[name].get_publisher_count()}
        expected = bool(published - heard)
        time_out = self._began + (UNHEARD_S if expected else SETTLE_S)
        timed_out = now >= max(self._joined + JOIN_S, time_out)
        complete = not (unheard or expected) and now >= self._heard + QUIET_S
        self._settled = timed_out or complete
        return self._settled

    def unheard(self) -> list[str]:
        """Return which of area and keep-out (single or as a set) have not come."""
        heard = {inputs.topic_of(name) for name in self.requests.last_messages}
        heard |= {inputs.KEEP_OUT} if inputs.KEEP_OUTS in heard else set()
        return [name for name in (inputs.AREA, inputs.KEEP_OUT) if name not in heard]

    def _check(self) -> None:
        """Call ``changed`` once the inputs are settled."""
        if self.settled() and self._timer is not None:
            self._timer.cancel()
            self._changed()

    def _take(self, topic: str, message: Any, info: dict[str, int]) -> None:
        sample = (info["source_timestamp"], info["publication_sequence_number"])
        if sample in self._samples[topic] and sample[0] > 0:  # 0: no stamp from the middleware
            return  # already received by the other subscription
        self._samples[topic].append(sample)
        self._heard = time.monotonic()
        requests, name = self.requests, inputs.name_of(topic, message)
        value, unusable = requests.values.get(name), requests.unusable.get(name)
        try:
            requests.use_message(topic, message)
        except MessageError as error:
            self._report(name, error)
        same = np.array_equal(requests.values.get(name), value)  # type: ignore[arg-type]
        if not same or requests.unusable.get(name) != unusable:
            self._changed()

    def _report(self, name: str, error: MessageError) -> None:
        effect = "the previous one stays in effect"
        if inputs.topic_of(name) in inputs.BINDING:
            effect = "no site is published until a usable one comes"
        text = f"{self.requests.unusable.get(name, error)}; {effect}"
        self._problems.report(f"{inputs.topic_of(name)}_{error.reason}", text)
