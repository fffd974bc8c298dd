# SPDX-License-Identifier: Apache-2.0
"""Timers and subscriptions for nodes in rclpy's `SingleThreadedExecutor`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.timer import Timer


def steady_timer(node: Node, period_s: float, callback: Callable[[], None]) -> Timer:
    """Create a timer on a steady clock: it continues when ``/clock`` stops or jumps."""
    return node.create_timer(period_s, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


class OnDemandGroup(CallbackGroup):
    """Subscriptions that wake the node only while ``wanted()`` is true. At other times their
    messages stay in the middleware's queue until `take_waiting` reads them.

    A wake-up costs as much as reading several messages, and poses are needed immediately only while
    a scan waits for one.
    """

    def __init__(self, wanted: Callable[[], bool]) -> None:
        super().__init__()
        self.wanted = wanted

    def can_execute(self, entity: Any) -> bool:
        """Return whether the executor serves the group; called before and after it waits."""
        return self.wanted()

    def beginning_execution(self, entity: Any) -> bool:
        """Allow every callback: there is only one thread."""
        return True

    def ending_execution(self, entity: Any) -> None:
        """Do nothing: there is only one thread."""


def take_waiting(subscription: Subscription) -> Iterator[Any]:
    """Read the messages that wait at a subscription, oldest first."""
    handle = subscription.handle
    with handle:
        while (taken := handle.take_message(subscription.msg_type, subscription.raw)) is not None:
            yield taken[0]
