# SPDX-License-Identifier: Apache-2.0
"""Publishers, subscriptions and services with their quality of service (QoS), and timers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    qos_policy_name_from_kind,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from std_srvs.srv import Trigger

from quadtree_lss.onboard.errors import QuadtreeLssError


def latched(depth: int = 1) -> QoSProfile:
    """Profile that keeps the newest ``depth`` messages for late subscribers."""
    profile = stream(depth, reliable=True)
    profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    return profile


def stream(depth: int, *, reliable: bool) -> QoSProfile:
    """Profile of measurements: queue of ``depth`` messages, none for late subscribers."""
    return QoSProfile(
        depth=depth,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.VOLATILE,
    )


TARGET_DEADLINE_S = 1.0
"""Deadline and lease of the target's publisher, s."""


def target() -> QoSProfile:
    """Profile of the target: latched, with a deadline that reveals a dead publisher."""
    profile = latched()
    profile.deadline = profile.liveliness_lease_duration = Duration(seconds=TARGET_DEADLINE_S)
    profile.liveliness = LivelinessPolicy.MANUAL_BY_TOPIC
    return profile


#: rclpy's default and durability.
OVERRIDABLE = QoSOverridingOptions(
    [getattr(QoSPolicyKind, name) for name in ("HISTORY", "DEPTH", "RELIABILITY", "DURABILITY")]
)


REMEDIES = {"RELIABILITY": "reliability: best_effort", "DURABILITY": "durability: volatile"}
"""Overrides with which a subscription accepts a publisher that offers less of a policy."""


def subscribe(
    node: Node,
    kind: Any,
    topic: str,
    callback: Any,
    profile: QoSProfile,
    matched: Callable[[int], None] | None = None,
    group: CallbackGroup | None = None,
    *,
    raw: bool = False,
) -> Subscription:
    """Create a subscription that logs a warning if a publisher's QoS is incompatible. ``matched``
    is called with the number of publishers whenever it changes; ``raw`` messages are bytes."""
    name = node.resolve_topic_name(topic)

    def incompatible(event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        node.get_logger().warning(
            f"a publisher of '{name}' offers a {policy} that this subscription does not accept"
            f" ({profile.reliability.name}, {profile.durability.name}): none of its messages will"
            f" arrive; change it, or qos_overrides.{name}.subscription.{REMEDIES.get(policy, '*')}"
        )

    return node.create_subscription(
        kind,
        topic,
        callback,
        profile,
        event_callbacks=SubscriptionEventCallbacks(
            incompatible_qos=incompatible,
            matched=None if matched is None else lambda event: matched(event.current_count),
        ),
        callback_group=group,
        qos_overriding_options=OVERRIDABLE,
        raw=raw,
    )


def subscribe_any_durability(
    node: Node, kind: Any, topic: str, callback: Any, depth: int = 1
) -> Subscription:
    """Create two subscriptions: volatile, which matches every publisher, and latched, which also
    receives earlier messages. Return the latched one. ``callback`` receives some messages twice."""
    subscribe(node, kind, topic, callback, stream(max(depth, 5), reliable=True))
    quiet = SubscriptionEventCallbacks(use_default_callbacks=False)
    return node.create_subscription(kind, topic, callback, latched(depth), event_callbacks=quiet)


def serve(node: Node, name: str, work: Callable[[], str]) -> None:
    """Create a ``std_srvs/Trigger`` service ``~/name``. It responds with success and the line that
    ``work`` returns, or with failure and the text of its `QuadtreeLssError`, and logs the line."""

    def respond(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            response.message, response.success = work(), True
            node.get_logger().info(response.message)
        except QuadtreeLssError as error:
            response.message, response.success = str(error), False
            node.get_logger().warning(response.message)
        return response

    node.create_service(Trigger, f"~/{name}", respond)


def advertise(
    node: Node, kind: Any, topic: str, profile: QoSProfile, matched: Any = None
) -> Publisher:
    """Create a publisher whose QoS can be overridden; rclpy logs incompatible subscribers.
    ``matched``: called with an event when the number of subscribers changes."""
    events = {"event_callbacks": PublisherEventCallbacks(matched=matched)}
    return node.create_publisher(kind, topic, profile, qos_overriding_options=OVERRIDABLE, **events)


class OnDemandGroup(CallbackGroup):
    """Subscriptions that wake the node only while ``wanted()`` is true, because a wake-up costs as
    much as reading several messages. At other times their messages stay in the middleware's queue
    until `take_waiting` reads them."""

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


def steady_timer(node: Node, period_s: float, callback: Callable[[], None]) -> Timer:
    """Create a timer on a steady clock: it continues when ``/clock`` stops or jumps."""
    return node.create_timer(period_s, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))
