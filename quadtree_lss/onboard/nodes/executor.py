# SPDX-License-Identifier: Apache-2.0
"""rclpy's executor for one node in one thread, without what several threads need."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Coroutine, Iterator
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from quadtree_lss.onboard.config.settings import ConfigError


def transforms_type() -> Any:
    """``tf2_msgs/TFMessage``, which comes with ROS, not with its wheels. Raises `ConfigError`: it
    cannot be imported."""
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        msg = "mount.source tf needs tf2_msgs (apt install ros-jazzy-tf2-msgs): or set mount.x ..."
        raise ConfigError(msg) from None
    return TFMessage


def steady_timer(node: Node, period_s: float, callback: Callable[[], None]) -> Timer:
    """A timer on a steady clock: it goes on when ``/clock`` stops or jumps."""
    return node.create_timer(period_s, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


class WhenWanted(CallbackGroup):
    """Subscriptions that wake the node only while their messages are wanted; at other times
    `arrived` takes them.

    A scan takes along what arrived before it, so only one that waits needs the next pose at once;
    each wake-up costs as much as taking several messages. ``wanted``: True while they are.
    """

    def __init__(self, wanted: Callable[[], bool]) -> None:
        super().__init__()
        self.wanted = wanted

    def can_execute(self, entity: Any) -> bool:
        """Asked by the executor before it waits and after it woke."""
        return self.wanted()

    def beginning_execution(self, entity: Any) -> bool:
        """Nothing to keep account of in a single thread."""
        return True

    def ending_execution(self, entity: Any) -> None:
        """Nothing either."""


def arrived(subscription: Subscription) -> Iterator[Any]:
    """Takes what has arrived at a subscription, oldest first."""
    of = subscription.handle
    with of:
        while (got := of.take_message(subscription.msg_type, subscription.raw)) is not None:
            yield got[0]


Work = tuple[Callable[[Any], Any], Any]
"""What takes from an entity that is ready, and the entity."""

KINDS = ("timer", "subscription", "client", "service")
"""Entities in the order in which they are served; events come before them."""


EVENTS_S = 0.1
"""How long those of the middleware may wait: publishers and subscribers that came or went, or do
not fit."""


class OneNodeExecutor(SingleThreadedExecutor):
    """Serves nodes in one thread; their callbacks may not wait for anything (``await``).

    rclpy's wakes itself twice after every callback, for other threads that it might have, and
    gathers all entities and makes a wait set anew each time that it wakes: that took a node more
    processor time than most of its callbacks. Here it is done when an entity came or went. Events,
    most of what a node has, need not wake it: they are looked at every `EVENTS_S`. Nor need timers
    on a steady clock, of which each reset would wake it: it waits no longer than until one is due.
    """

    def __init__(self, *, context: Context | None = None) -> None:
        super().__init__(context=context)
        self._changed = True
        self._ready: Iterator[Work] = iter(())
        self._entities: dict[int, Any] = {}
        self._handles: list[tuple[CallbackGroup, Callable[[Any], int], Any]] = []
        self._events: list[Any] = []
        self._steady: list[Timer] = []
        self._look_at_events = 0.0
        self._groups: list[WhenWanted] = []
        self._set: Any = None

    def add_node(self, node: Any) -> bool:
        """As of the base class."""
        self._changed = True
        return bool(super().add_node(node))

    def wake(self) -> None:
        """Called by a node when one of its entities came or went."""
        self._changed = True
        super().wake()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Runs one callback that is due, or waits until one is, at most so long. Raises
        `ExternalShutdownException`: the context was shut down."""
        work = next(self._ready, None)
        if work is None:
            self._ready = self._wait(-1 if timeout_sec is None else round(1e9 * timeout_sec))
            work = next(self._ready, None)
        if work is None:
            return
        take, entity = work
        if entity.callback_group.can_execute(entity):
            execute = take(entity)
            if execute is not None:
                _finish(execute())

    def _wait(self, timeout_ns: int) -> Iterator[Work]:
        """What is ready, each looked at when its turn comes: callbacks cancel timers."""
        if not self._context.ok():
            raise ExternalShutdownException
        if self._changed:
            self._look_through()
        waits = self._set
        waits.clear_entities()
        held = [group for group in self._groups if not group.wanted()]
        for group, add, handle in self._handles:
            if group not in held:
                add(handle)
        events = []
        if (now := time.monotonic()) >= self._look_at_events:
            self._look_at_events = now + EVENTS_S
            # With its subscription: what arrives there would wake the node by its events.
            events = [event for event in self._events if event.callback_group not in held]
        for event in events:
            event.add_to_wait_set(waits)
        waits.add_guard_condition(self._guard.handle)
        left = [timeout_ns] if timeout_ns >= 0 else []
        for timer in self._steady:
            if (until := timer.time_until_next_call()) is not None:  # of one that is not cancelled
                left.append(max(until, 0))
        waits.wait(min(left, default=-1))
        if not self._context.ok():
            raise ExternalShutdownException
        for event in events:
            if event.is_ready(waits):
                yield self._take_waitable, event
        for timer in self._steady:
            if _is_due(timer):
                yield self._take_timer, timer
        for kind, ready in [(kind, waits.get_ready_entities(kind)) for kind in KINDS]:
            for entity in map(self._entities.__getitem__, ready):
                if kind != "timer" or _is_due(entity):
                    yield getattr(self, f"_take_{kind}"), entity

    def _look_through(self) -> None:
        """Finds the nodes' entities and makes a wait set that has room for them."""
        self._changed = False
        nodes = self.get_nodes()
        served = [(k, one) for k in KINDS for node in nodes for one in getattr(node, f"{k}s")]
        timers = [timer for node in nodes for timer in node.timers]
        self._steady = [of for of in timers if of.clock.clock_type == ClockType.STEADY_TIME]
        served = [(k, one) for k, one in served if one not in self._steady]
        self._events = [event for node in nodes for event in node.waitables]
        groups = {one.callback_group for _, one in served}
        self._groups = [group for group in groups if isinstance(group, WhenWanted)]
        room = Counter(kind for kind, _ in served)
        self._set = rclpy_implementation.WaitSet(
            room["subscription"],
            1,
            room["timer"],
            room["client"],
            room["service"],
            len(self._events),
            self._context.handle,
        )
        self._entities = {one.handle.pointer: one for _, one in served}
        self._handles = [
            (one.callback_group, getattr(self._set, f"add_{k}"), one.handle) for k, one in served
        ]


def _is_due(timer: Any) -> bool:
    """False for one that was cancelled or destroyed after it became due."""
    try:
        with timer.handle:
            return bool(timer.handle.is_timer_ready())
    except InvalidHandle:
        return False


def _finish(callback: Coroutine[Any, Any, None]) -> None:
    """Runs what rclpy wraps a callback in. Raises `RuntimeError`: it waits for something."""
    try:
        callback.send(None)
    except StopIteration:
        return
    callback.close()
    msg = "a callback waits for something, which this executor does not serve"
    raise RuntimeError(msg)
