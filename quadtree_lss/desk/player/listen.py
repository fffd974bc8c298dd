# SPDX-License-Identifier: Apache-2.0
"""Some seconds of the topics that are live, in memory: what reads bags reads them, too."""

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

HEARD = (types.SCAN_TYPE, *types.POSE_TYPES, types.GIMBAL_TYPE)
if importlib.util.find_spec("tf2_msgs") is not None:  # no wheel has it
    HEARD = (*HEARD, types.TRANSFORMS_TYPE)
LOOK_S = 0.2


class ListenError(QuadtreeLssError):
    """Nothing is sent that could be looked at."""


def listen(seconds: float) -> MessageBag:
    """What is sent of clouds, poses, gimbal angles and transforms. ``seconds``: from the first
    cloud or pose on, and so long it waits for one. Raises `ListenError`: none came."""
    context = Context()
    rclpy.init(context=context)
    node = Node("doctor", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    kinds: dict[str, str] = {}
    heard: list[tuple[str, int, bytes]] = []
    try:
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            executor.spin_once(timeout_sec=LOOK_S)
            for name, (kind, *_) in node.get_topic_names_and_types():
                if name not in kinds and kind in HEARD:
                    kinds[name] = kind
                    _subscribe(node, name, kind, heard)
                    if not heard:
                        until = time.monotonic() + seconds
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()
    if not heard:
        there = ", ".join(sorted(kinds)) or "none"
        raise ListenError(f"nothing came in {seconds:g} s; topics of clouds and poses: {there}")
    store, counts = types.typestore(ros1=False), Counter(name for name, *_ in heard)
    return MessageBag(
        "live",
        [Topic(name, kind, counts[name]) for name, kind in kinds.items()],
        (heard[0][1], heard[-1][1]),
        [(name, at, partial(store.deserialize_cdr, raw, kinds[name])) for name, at, raw in heard],
    )


def _subscribe(node: Node, name: str, kind: str, heard: list[tuple[str, int, bytes]]) -> None:
    def hear(raw: Any) -> None:
        heard.append((name, time.time_ns(), bytes(raw)))

    kept = latched(100)  # every broadcaster keeps its own
    profile = kept if kind == types.TRANSFORMS_TYPE else stream(100, reliable=False)
    node.create_subscription(TYPES[kind], name, hear, profile, raw=True)
