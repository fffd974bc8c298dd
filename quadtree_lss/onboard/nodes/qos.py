# SPDX-License-Identifier: Apache-2.0
"""Topics with their quality of service, what the log says when two ends do not match; services."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
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
from std_srvs.srv import Trigger

from quadtree_lss.onboard.errors import QuadtreeLssError


def latched(depth: int = 1) -> QoSProfile:
    """One message, or the newest ``depth``, that late subscribers get as well."""
    profile = stream(depth, reliable=True)
    profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    return profile


def stream(depth: int, *, reliable: bool) -> QoSProfile:
    """Measurements: the newest ``depth``, nothing for late subscribers."""
    return QoSProfile(
        depth=depth,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.VOLATILE,
    )


TARGET_DEADLINE_S = 1.0
"""A subscriber that hears nothing of the target for so long may take its publisher for dead."""


def target() -> QoSProfile:
    """Latched, and said again in time: whoever asks for a deadline learns of a dead publisher."""
    profile = latched()
    profile.deadline = profile.liveliness_lease_duration = Duration(seconds=TARGET_DEADLINE_S)
    profile.liveliness = LivelinessPolicy.MANUAL_BY_TOPIC
    return profile


#: As rclpy's default, and durability.
OVERRIDABLE = QoSOverridingOptions(
    [getattr(QoSPolicyKind, name) for name in ("HISTORY", "DEPTH", "RELIABILITY", "DURABILITY")]
)


REMEDIES = {"RELIABILITY": "reliability: best_effort", "DURABILITY": "durability: volatile"}
"""What makes a subscription accept a publisher that offers less of a policy."""


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
    """Subscription that warns by name when a publisher's QoS cannot be matched. ``matched``: called
    with the number of publishers whenever it changes. ``group``: callback group, the node's default
    one if None. ``raw``: messages come as bytes, not deserialised."""
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
    node: Node, kind: Any, topic: str, callback: Any, kept: int = 1
) -> Subscription:
    """Latched, to get what was sent before, which is returned; and volatile, which matches
    publishers that keep nothing. Both ways end with the newest message, of ``kept``."""
    subscribe(node, kind, topic, callback, stream(max(kept, 5), reliable=True))
    quiet = SubscriptionEventCallbacks(use_default_callbacks=False)
    return node.create_subscription(kind, topic, callback, latched(kept), event_callbacks=quiet)


def serve(node: Node, name: str, work: Callable[[], str]) -> None:
    """A ``std_srvs/Trigger`` service ``~/name``: the line that ``work`` returns, and success; of
    what it raises, a `QuadtreeLssError`, the line alone. Both go to the log."""

    def answer(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            response.message, response.success = work(), True
            node.get_logger().info(response.message)
        except QuadtreeLssError as error:
            response.message, response.success = str(error), False
            node.get_logger().warning(response.message)
        return response

    node.create_service(Trigger, f"~/{name}", answer)


def advertise(
    node: Node, kind: Any, topic: str, profile: QoSProfile, matched: Any = None
) -> Publisher:
    """Publisher whose QoS can be overridden; rclpy tells of subscribers that it cannot serve.
    ``matched``: called with an event when subscribers came or went."""
    events = {"event_callbacks": PublisherEventCallbacks(matched=matched)}
    return node.create_publisher(kind, topic, profile, qos_overriding_options=OVERRIDABLE, **events)
