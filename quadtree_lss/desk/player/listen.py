# SPDX-License-Identifier: Apache-2.0
"""Some seconds of the topics that are live, as a bag: what reads bags reads them, too."""

from __future__ import annotations

import importlib.util
import time
from pathlib import Path
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rosbags.rosbag2 import StoragePlugin, Writer

from quadtree_lss.desk.bags.message_types import (
    GIMBAL_TYPE,
    POSE_TYPES,
    SCAN_TYPE,
    TRANSFORMS_TYPE,
    typestore,
)
from quadtree_lss.onboard.errors import QuadtreeLssError
from quadtree_lss.onboard.nodes.qos import latched, stream
from quadtree_lss.onboard.nodes.ros_messages import TYPES

HEARD = (SCAN_TYPE, *POSE_TYPES, GIMBAL_TYPE)
if importlib.util.find_spec("tf2_msgs") is not None:  # no wheel has it
    HEARD = (*HEARD, TRANSFORMS_TYPE)
LOOK_S = 0.2


class ListenError(QuadtreeLssError):
    """Nothing is sent that could be looked at."""


def record_live(path: Path, seconds: float) -> Path:
    """Writes what is sent of clouds, poses, gimbal angles and transforms.

    Args:
        path: Of the bag, which is not there yet.
        seconds: From the first cloud or pose on, and so long it waits for one.

    Raises:
        ListenError: none came.
    """
    context = Context()
    rclpy.init(context=context)
    node = Node("doctor", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    heard: dict[str, str] = {}
    try:
        with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            recorder = _Recorder(node, writer)
            until = time.monotonic() + seconds
            while time.monotonic() < until:
                executor.spin_once(timeout_sec=LOOK_S)
                if recorder.look() and recorder.count == 0:
                    until = time.monotonic() + seconds
            heard = recorder.topics
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()
    if not recorder.count:
        there = ", ".join(sorted(heard)) or "none"
        raise ListenError(f"nothing came in {seconds:g} s; topics of clouds and poses: {there}")
    return path


class _Recorder:
    """Subscribes to what appears, and writes its bytes.

    Attributes:
        topics: Type by name.
        count: Messages.
    """

    def __init__(self, node: Node, writer: Writer) -> None:
        self._node, self._writer, self._store = node, writer, typestore(False, HEARD)
        self.topics: dict[str, str] = {}
        self.count = 0

    def look(self) -> bool:
        """Subscribes to what is new; whether there was something."""
        found = False
        for name, kinds in self._node.get_topic_names_and_types():
            if name not in self.topics and kinds[0] in HEARD:
                self.topics[name], found = kinds[0], True
                self._subscribe(name, kinds[0])
        return found

    def _subscribe(self, name: str, kind: str) -> None:
        connection = self._writer.add_connection(name, kind, typestore=self._store)

        def write(raw: Any) -> None:
            self.count += 1
            self._writer.write(connection, time.time_ns(), bytes(raw))

        profile = latched() if kind == TRANSFORMS_TYPE else stream(100, reliable=False)
        self._node.create_subscription(TYPES[kind], name, write, profile, raw=True)
