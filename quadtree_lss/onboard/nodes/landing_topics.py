# SPDX-License-Identifier: Apache-2.0
"""What guidance says: ``landing/area``, keep-outs, ``target`` and ``dispersion``."""

from __future__ import annotations

import functools
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.timer import Timer

from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.landing_inputs import (
    AREA,
    BINDING,
    KEEP_OUT,
    KEEP_OUTS,
    MAX_KEEP_OUTS,
    TYPES,
    LandingWishes,
    name_of,
    topic_of,
)
from quadtree_lss.onboard.nodes.diagnostics import Problems
from quadtree_lss.onboard.nodes.executor import steady_timer
from quadtree_lss.onboard.nodes.qos import subscribe_twice
from quadtree_lss.onboard.nodes.ros_messages import TYPES as ROS_TYPES

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


class LandingTopics:
    """Subscribes to the topics and holds what came last, `LandingWishes` for the map's frame.

    Each is subscribed to twice (`qos.subscribe_twice`). ``changed`` is called after each change,
    and when `settled` has become true, which it is not before those of ``required``
    (``lss.required_input``) came.
    """

    def __init__(
        self, node: Node, problems: Problems, changed: Callable[[], None], required: str
    ) -> None:
        self.wishes = LandingWishes(None)
        self._required = (AREA, KEEP_OUT) if required == "both" else (required,)
        self._node, self._problems, self._changed = node, problems, changed
        self._joined = self._heard = time.monotonic()
        self._began: float | None = None
        self._timer: Timer | None = None
        self._settled = False
        self._samples: dict[str, deque[tuple[int, int]]] = {}
        self._latched: dict[str, Any] = {}
        for name, kind in TYPES.items():
            take = functools.partial(self._take, name)
            kind, topic = ROS_TYPES[kind], f"landing/{name}"
            kept = MAX_KEEP_OUTS if name == KEEP_OUTS else 1
            self._samples[name] = deque(maxlen=2 * kept)
            self._latched[name] = subscribe_twice(node, kind, topic, take, kept)

    def states(self) -> dict[str, object]:
        """Whether each is set, for the diagnostics."""
        values, unusable = self.wishes.values, {topic_of(k) for k in self.wishes.unusable}
        held = {topic_of(name) for name, value in values.items() if value is not None}
        return {name: "unusable" if name in unusable else name in held for name in TYPES}

    def use_frame(self, frame: str) -> None:
        """The map is in this frame: what is held counts for it or does not, whenever it came."""
        before = dict(self.wishes.unusable)
        for name, error in self.wishes.use_frame(frame).items():
            if self.wishes.unusable.get(name) != before.get(name):
                self._report(name, error)

    def settled(self) -> bool:
        """True once both area and keep-out have come, or have had the time to and need not come.

        Until then nobody knows where landing is wanted. Call it first with the first map.
        """
        if self._settled:
            return True
        now = time.monotonic()
        if self._began is None:
            self._began = now
            self._timer = steady_timer(self._node, LOOK_S, self._look)
        unheard = self.unheard()
        if any(name in self._required for name in unheard):
            return False
        heard = {topic_of(name) for name in self.wishes.heard}
        there = {name for name in BINDING if self._latched[name].get_publisher_count()}
        expected = bool(there - heard)
        time_out = self._began + (UNHEARD_S if expected else SETTLE_S)
        in_time = now >= max(self._joined + JOIN_S, time_out)
        complete = not (unheard or expected) and now >= self._heard + QUIET_S
        self._settled = in_time or complete
        return self._settled

    def unheard(self) -> list[str]:
        """Which of area and keep-out have not come; one of the set is a keep-out, too."""
        heard = {topic_of(name) for name in self.wishes.heard}
        heard |= {KEEP_OUT} if KEEP_OUTS in heard else set()
        return [name for name in (AREA, KEEP_OUT) if name not in heard]

    def _look(self) -> None:
        """Whoever asked in vain is told, whoever else may have asked in between."""
        if self.settled() and self._timer is not None:
            self._timer.cancel()
            self._changed()

    def _take(self, topic: str, message: Any, info: dict[str, int]) -> None:
        sample = (info["source_timestamp"], info["publication_sequence_number"])
        if sample in self._samples[topic] and sample[0] > 0:  # 0: the middleware does not say
            return  # one that was taken, come by the other way
        self._samples[topic].append(sample)
        self._heard = time.monotonic()
        wishes, name = self.wishes, name_of(topic, message)
        value, unusable = wishes.values.get(name), wishes.unusable.get(name)
        try:
            wishes.take(topic, message)
        except MessageError as error:
            self._report(name, error)
        same = np.array_equal(wishes.values.get(name), value)  # type: ignore[arg-type]
        if not same or wishes.unusable.get(name) != unusable:
            self._changed()

    def _report(self, name: str, error: MessageError) -> None:
        effect = "what was set before holds"
        if topic_of(name) in BINDING:
            effect = "no site is given out until one comes that can"
        text = f"{self.wishes.unusable.get(name, error)}; {effect}"
        self._problems.report(f"{topic_of(name)}_{error.reason}", text)
