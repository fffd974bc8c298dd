# SPDX-License-Identifier: Apache-2.0
"""Collect the messages of the nodes in a thread, for the demo, flights and tests."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from quadtree_lss.onboard.messages.clouds import stamp_ns
from quadtree_lss.onboard.messages.outputs import TOPIC_TYPES
from quadtree_lss.onboard.nodes.qos import latched
from quadtree_lss.onboard.nodes.ros_messages import TYPES

TOPICS: Mapping[str, Any] = {name: TYPES[kind] for name, kind in TOPIC_TYPES.items()}


class Listener:
    """Context manager that holds the ``newest`` message of each latched topic, by default of all
    topics of the nodes. The caller may add publishers and clients to ``node``."""

    def __init__(
        self, domain: int, topics: Mapping[str, Any] = TOPICS, name: str = "listener"
    ) -> None:
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = Node(name, context=self._context)
        self._changed = threading.Condition()
        self.newest: dict[str, Any] = {}
        for topic, kind in topics.items():
            self.node.create_subscription(kind, topic, partial(self._keep, topic), latched())
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)

    def __enter__(self) -> Listener:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(5.0)
        self._executor.shutdown()
        self._context.try_shutdown()

    def stamp(self, topic: str) -> int | None:
        """Stamp of the newest message, ns; None without one."""
        message = self.newest.get(topic)
        return None if message is None else stamp_ns(message.header)

    def wait_for(self, condition: Callable[[], object], timeout: float = 20.0) -> bool:
        """Wait until ``condition()``, checked after each message; return whether it became true."""
        deadline = time.monotonic() + timeout
        with self._changed:
            while not condition():
                left = deadline - time.monotonic()
                if left <= 0.0:
                    return False
                self._changed.wait(min(left, 0.1))
            return True

    def _keep(self, topic: str, message: Any) -> None:
        with self._changed:
            self.newest[topic] = message
            self._changed.notify_all()

    def _spin(self) -> None:
        while not self._stop.is_set():
            self._executor.spin_once(timeout_sec=0.2)
