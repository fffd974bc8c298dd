# SPDX-License-Identifier: Apache-2.0
"""Play a bag into running nodes without changing its bytes; record live topics in memory.

`ros2 bag play` is not available as a wheel, does not read damaged bags, and does not wait for
subscribers.
"""

from __future__ import annotations

import contextlib
import importlib.util
import math
import sys
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import rclpy
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.exceptions import NameValidationException
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock

from quadtree_lss.desk.bags import message_types as types
from quadtree_lss.desk.bags import topics
from quadtree_lss.desk.bags.bag import Bag, MessageBag, Topic
from quadtree_lss.desk.bags.compression import DamagedError, plain_message
from quadtree_lss.desk.replay.stream import SECOND_NS, MapPairs, Part, Progress
from quadtree_lss.onboard.errors import QuadtreeLssError
from quadtree_lss.onboard.messages import landing_inputs
from quadtree_lss.onboard.messages.outputs import CELLS, OBSERVED, TOPIC_TYPES
from quadtree_lss.onboard.nodes.qos import latched, stream
from quadtree_lss.onboard.nodes.ros_messages import TYPES, time_message

MATCH_PAUSE_S = 0.5
"""Pause after a publisher has matched its subscriber, which may not be ready yet."""
CLOCK_S = 0.02
"""Largest interval between two messages on ``/clock``, s of the steady clock."""
DEPTH = 200
LANDING = {f"/landing/{name}": kind for name, kind in landing_inputs.TYPES.items()}
MAPS = {f"/{name}": TOPIC_TYPES[name] for name in (CELLS, OBSERVED)}
KINDS = topics.KINDS | LANDING | MAPS
OPTIONAL = (topics.GIMBAL_TOPIC, *LANDING)
"""Played even without subscribers."""
HEARD_TYPES = (types.SCAN_TYPE, *types.POSE_TYPES, types.GIMBAL_TYPE)
if importlib.util.find_spec("tf2_msgs") is not None:  # not available as a wheel
    HEARD_TYPES = (*HEARD_TYPES, types.TRANSFORMS_TYPE)
SPIN_PERIOD_S = 0.2


class PlayError(QuadtreeLssError):
    """The bag cannot be played, has no subscribers, or no message was received."""


@dataclass(frozen=True)
class PlayReport:
    """Numbers of sent messages, duration, s, and a line for each loss."""

    scans: int
    poses: int
    duration: float
    losses: tuple[str, ...]
    maps: int = 0


def play(
    bag: Bag,
    names: Mapping[str, str],
    part: Part,
    *,
    rate: float = 1.0,
    wait: float = 15.0,
    namespace: str = "",
    remap: Sequence[str] = (),
    progress: Progress | None = None,
) -> PlayReport:
    """Play a part of an open bag into running nodes, with the bag's time on ``/clock``.

    ``names``: topics as of `played_topics`; ``rate``: bag seconds per second; ``wait``: for
    subscribers, s; ``namespace``, ``remap`` (``FROM:=TO``): of the topics. Raises `PlayError`: no
    valid rate, no subscriber in time.
    """
    if not 0.0 < rate < math.inf:
        raise PlayError(f"rate {rate:g} is not positive and finite")
    context = Context()
    # Pass only ROS arguments on; --remap of this program resembles an old one of ROS.
    ours = sys.argv.index("--ros-args") if "--ros-args" in sys.argv else len(sys.argv)
    rclpy.init(args=sys.argv[ours:], context=context)
    try:
        node = player_node(context, namespace, remap, names.values())
        publishers = _publishers(node, names)
        needed = [p for recorded, p in publishers.items() if names[recorded] not in OPTIONAL]
        wait_for_subscribers(node, needed, wait)
        requests = [recorded for recorded, name in names.items() if name in LANDING]
        for message in bag.messages(requests, 0, part.start_ns):
            publishers[message.topic].publish(_serialised(message.raw))
        clock = node.create_publisher(Clock, "/clock", stream(10, reliable=True))
        began_ns, began, sent = None, time.monotonic(), Counter[str]()
        for topic, received_ns, raw in part.messages(bag, list(names), progress):
            began_ns = received_ns if began_ns is None else began_ns
            _wait_until(received_ns, clock, began_ns, began, rate)
            publishers[topic].publish(_serialised(raw))
            sent[names[topic]] += 1
        seconds = time.monotonic() - began
        for publisher in publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=5))
        return PlayReport(
            scans=sent[topics.SCAN_TOPIC] + sent[topics.DEPTH_TOPIC],
            poses=sent[topics.POSE_TOPIC] + sent[topics.ODOMETRY_TOPIC],
            duration=seconds,
            losses=tuple(bag.losses),
            maps=sent[f"/{CELLS}"],
        )
    finally:
        context.try_shutdown()


def _wait_until(bag_ns: int, clock: Publisher, began_ns: int, began_s: float, rate: float) -> None:
    """Publish the time of the bag until ``bag_ns``; it was ``began_ns`` at ``began_s``."""
    while True:
        now_ns = began_ns + round((time.monotonic() - began_s) * rate * SECOND_NS)
        clock.publish(Clock(clock=time_message(min(now_ns, bag_ns))))
        if now_ns >= bag_ns:
            return
        time.sleep(min((bag_ns - now_ns) / (rate * SECOND_NS), CLOCK_S))


def played_topics(
    bag: Bag, scan_topic: str | None = None, pose_topic: str | None = None
) -> dict[str, str]:
    """Map the topics of an open bag to the names under which they are published.

    ``lidar/gimbal``, areas, keep-outs and targets are played if recorded, of a bag of maps only
    ``map/cells`` and ``map/observed``. Raises `PlayError`: a ROS 1 bag; `BagError`: as `replay`.
    """
    if bag.ros1:
        msg = f"{bag.path} is a ROS 1 bag: replay it offline, or convert it to play it to ROS 2"
        raise PlayError(msg)
    pairs = MapPairs.of_maps_only(bag, scan_topic)
    if pairs is not None:
        return dict(zip(pairs.topics, MAPS, strict=True))
    scans, _, camera = topics.choose_scan_topic(bag, scan_topic, "points")
    poses, kind, _ = topics.choose_pose_topic(bag, pose_topic, "pose", scans)
    names = {
        scans: topics.DEPTH_TOPIC if camera else topics.SCAN_TOPIC,
        **({camera: topics.CAMERA_TOPIC} if camera else {}),
        poses: topics.ODOMETRY_TOPIC if kind == types.ODOMETRY_TYPE else topics.POSE_TOPIC,
    }
    names |= {topic: f"/landing/{name}" for topic, name in topics.landing_topics(bag).items()}
    if any((t.name, t.type) == (topics.GIMBAL_TOPIC, types.GIMBAL_TYPE) for t in bag.topics):
        names[topics.GIMBAL_TOPIC] = topics.GIMBAL_TOPIC
    return names


def _serialised(raw: bytes) -> bytes:
    """Decompress a message if necessary; damaged ones are left for the nodes to reject."""
    with contextlib.suppress(DamagedError):
        return plain_message(raw)
    return raw


def _publishers(node: Node, names: Mapping[str, str]) -> dict[str, Publisher]:
    """Create a publisher for each topic of the bag."""
    found = {}
    for recorded, name in names.items():
        profile = stream(DEPTH, reliable=True)
        if name in (*MAPS, *LANDING):
            profile = latched(landing_inputs.MAX_KEEP_OUTS if name.endswith("keep_outs") else 1)
        found[recorded] = node.create_publisher(TYPES[KINDS[name]], name.lstrip("/"), profile)
    return found


def player_node(
    context: Context, namespace: str, remap: Sequence[str], played: Iterable[str]
) -> Node:
    """Create the node. Raises `PlayError`: a name is invalid, or a remapped topic is not played."""
    known = [name.lstrip("/") for name in played]
    arguments = ["--ros-args"]
    for rule in remap:
        name, _, to = rule.lstrip("/").partition(":=")
        if name not in known:
            msg = f"--remap {rule}: expected FROM:=TO, where FROM is one of {', '.join(known)}"
            raise PlayError(msg)
        arguments += ["-r", f"{name}:={to}"]
    try:
        # The node is never spun, so its parameter services could not respond.
        how = {"namespace": namespace, "cli_args": arguments, "start_parameter_services": False}
        return Node("bag_player", context=context, **how)
    except (NameValidationException, rclpy_implementation.RCLError) as error:
        msg = f"--namespace or --remap: {str(error).splitlines()[0].split(', at /')[0]}"
        raise PlayError(msg) from None


def wait_for_subscribers(node: Node, publishers: Sequence[Publisher], wait: float) -> None:
    """Wait until each publisher has a subscriber. Raises `PlayError` after ``wait`` s."""
    deadline = time.monotonic() + wait
    while missing := [p for p in publishers if not p.get_subscription_count()]:
        if time.monotonic() > deadline:
            names = ", ".join(p.topic_name for p in missing)
            msg = f"no subscriber of {names} within {wait:g} s: {_subscribed(node, missing)}"
            raise PlayError(msg)
        time.sleep(0.05)
    time.sleep(MATCH_PAUSE_S)


def _subscribed(node: Node, publishers: Sequence[Publisher]) -> str:
    """Describe the topics of the same types that have subscribers."""
    kinds = {f"{p.msg_type.__module__.split('.')[0]}/msg/{p.msg_type.__name__}" for p in publishers}
    found = [
        name
        for name, types in node.get_topic_names_and_types()
        if kinds & set(types) and node.count_subscribers(name)
    ]
    if not found:
        return "no topic of these types has one; are the nodes running?"
    return f"subscribed are {', '.join(sorted(found))} (--namespace, --remap FROM:=TO)"


def listen(seconds: float) -> MessageBag:
    """Record clouds, poses, gimbal angles and transforms for some ``seconds`` after the first topic
    appears, for which it waits as long. Raises `PlayError`: no message was received."""
    context = Context()
    rclpy.init(context=context)
    node = Node("doctor", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    kinds: dict[str, str] = {}
    received: list[tuple[str, int, bytes]] = []

    def on_message(name: str, raw: bytes) -> None:
        received.append((name, time.time_ns(), bytes(raw)))

    try:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            executor.spin_once(timeout_sec=SPIN_PERIOD_S)
            for name, (kind, *_) in node.get_topic_names_and_types():
                if name not in kinds and kind in HEARD_TYPES:
                    kinds[name] = kind
                    profile = stream(100, reliable=False)
                    if kind == types.TRANSFORMS_TYPE:
                        profile = latched(100)  # one for each broadcaster
                    hear = partial(on_message, name)
                    node.create_subscription(TYPES[kind], name, hear, profile, raw=True)
                    if not received:
                        deadline = time.monotonic() + seconds
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()
    if not received:
        there = ", ".join(sorted(kinds)) or "none"
        raise PlayError(f"no message in {seconds:g} s; topics of clouds and poses: {there}")
    decode, counts = types.typestore(ros1=False).deserialize_cdr, Counter(r[0] for r in received)
    return MessageBag(
        "live",
        [Topic(name, kind, counts[name]) for name, kind in kinds.items()],
        (received[0][1], received[-1][1]),
        [(name, at, partial(decode, raw, kinds[name])) for name, at, raw in received],
    )
