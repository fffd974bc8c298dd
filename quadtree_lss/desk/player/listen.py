# SPDX-License-Identifier: Apache-2.0
"""Record some seconds of live topics as a bag in memory."""

from __future__ import annotations

import importlib.util
import time
from collections import Counter
from functools import partial
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from quadtree_lss.desk.bags import message_types as types
from quadtree_lss.desk.bags.bag import MessageBag, Topic
from quadtree_lss.onboard.errors import QuadtreeLssError
from quadtree_lss.onboard.nodes.qos import latched, stream
from quadtree_lss.onboard.nodes.ros_messages import TYPES

HEARD_TYPES = (types.SCAN_TYPE, *types.POSE_TYPES, types.GIMBAL_TYPE)
if importlib.util.find_spec("tf2_msgs") is not None:  # not available as a wheel
    HEARD_TYPES = (*HEARD_TYPES, types.TRANSFORMS_TYPE)
SPIN_PERIOD_S = 0.2


class ListenError(QuadtreeLssError):
    """No message was received."""


def listen(seconds: float) -> MessageBag:
    """Record clouds, poses, gimbal angles and transforms for some ``seconds`` after the first topic
    appears, for which it waits as long. Raises `ListenError`: no message was received."""
    context = Context()
    rclpy.init(context=context)
    node = Node("doctor", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    kinds: dict[str, str] = {}
    received: list[tuple[str, int, bytes]] = []
    try:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            executor.spin_once(timeout_sec=SPIN_PERIOD_S)
            for name, (kind, *_) in node.get_topic_names_and_types():
                if name not in kinds and kind in HEARD_TYPES:
                    kinds[name] = kind
                    _subscribe(node, name, kind, received)
                    if not received:
                        deadline = time.monotonic() + seconds
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()
    if not received:
        there = ", ".join(sorted(kinds)) or "none"
        raise ListenError(f"no message in {seconds:g} s; topics of clouds and poses: {there}")
    store, counts = types.typestore(ros1=False), Counter(name for name, *_ in received)
    return MessageBag(
        "live",
        [Topic(name, kind, counts[name]) for name, kind in kinds.items()],
        (received[0][1], received[-1][1]),
        [
            (name, at, partial(store.deserialize_cdr, raw, kinds[name]))
            for name, at, raw in received
        ],
    )


def _subscribe(node: Node, name: str, kind: str, received: list[tuple[str, int, bytes]]) -> None:
    def on_message(raw: Any) -> None:
        received.append((name, time.time_ns(), bytes(raw)))

    kept = latched(100)  # one for each broadcaster
    profile = kept if kind == types.TRANSFORMS_TYPE else stream(100, reliable=False)
    node.create_subscription(TYPES[kind], name, on_message, profile, raw=True)
