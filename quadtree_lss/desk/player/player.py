# SPDX-License-Identifier: Apache-2.0
"""Plays scans and poses, or maps, of a bag to running nodes, their bytes as recorded."""

from __future__ import annotations

import math
import struct
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
import zstandard
from geometry_msgs.msg import (
    PointStamped,
    PolygonStamped,
    PoseWithCovarianceStamped,
    TransformStamped,
)
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import PointCloud2

from quadtree_lss.desk.bags.bag import Bag
from quadtree_lss.desk.bags.message_types import GIMBAL_TYPE, ODOMETRY_TYPE, SCAN_TYPE
from quadtree_lss.desk.bags.recorded_file import RawMessage
from quadtree_lss.desk.bags.topics import (
    GIMBAL_TOPIC,
    ODOMETRY_TOPIC,
    POSE_TOPIC,
    SCAN_TOPIC,
    choose_pose_topic,
    choose_topic,
    landing_topics,
)
from quadtree_lss.desk.player.clock import SECOND_NS, PlayTime
from quadtree_lss.desk.player.keyboard import Keyboard
from quadtree_lss.desk.player.peers import PlayError, player_node, wait_for_subscribers
from quadtree_lss.desk.replay.stream import MapPairs, Stream
from quadtree_lss.onboard.messages.outputs import CELLS, OBSERVED
from quadtree_lss.onboard.nodes.qos import latched, stream

DEPTH = 200
BAR_S = 0.2
"""Between two changes of the progress bar."""
KINDS = {
    SCAN_TOPIC: PointCloud2,
    POSE_TOPIC: PoseWithCovarianceStamped,
    ODOMETRY_TOPIC: Odometry,
    GIMBAL_TOPIC: TransformStamped,
    "/landing/area": PolygonStamped,
    "/landing/keep_out": PolygonStamped,
    "/landing/target": PointStamped,
    "/landing/dispersion": PoseWithCovarianceStamped,
    f"/{CELLS}": PointCloud2,
    f"/{OBSERVED}": OccupancyGrid,
}
LANDING_TOPICS = ("/landing/area", "/landing/keep_out", "/landing/target", "/landing/dispersion")
OPTIONAL = (GIMBAL_TOPIC, *LANDING_TOPICS)
"""Played though nobody may listen."""
MAP_TOPICS = (f"/{CELLS}", f"/{OBSERVED}")
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


@dataclass(frozen=True)
class PlayReport:
    """What was sent.

    Attributes:
        scans, poses, maps: Number of messages.
        duration: Time from the first to the last of them, s.
        losses: One line for each piece of the bag that could not be read.
    """

    scans: int
    poses: int
    duration: float
    losses: tuple[str, ...]
    maps: int = 0


def play(
    bag: str | Path,
    *,
    rate: float = 1.0,
    clock: bool = True,
    scan_topic: str | None = None,
    pose_topic: str | None = None,
    start: float = 0.0,
    duration: float | None = None,
    wait: float = 15.0,
    namespace: str = "",
    remap: Sequence[str] = (),
    domain_id: int | None = None,
    progress: Callable[[float, float], None] | None = None,
) -> PlayReport:
    """Plays a ROS 2 bag on ``lidar/points`` and ``nav/pose``, as fast as it was recorded.

    Odometry goes out on ``nav/odometry`` instead. ``lidar/gimbal`` and latched ``landing/area``,
    ``landing/keep_out`` and ``landing/target`` are played if they were recorded, the last three
    with what was said before the part that is played. A bag that holds maps and no scans is played
    on ``map/cells`` and ``map/observed``, latched. Waits until scans and poses, or maps, have a
    subscriber, and at the end until all was acknowledged. The services ``/bag_player/pause``,
    ``…/resume`` and ``…/toggle_paused`` hold it up, as does the space bar of its terminal.

    Args:
        bag: Directory or single file.
        rate: Bag seconds per second.
        clock: Publish the bag's time on ``/clock``.
        scan_topic, pose_topic: Topics in the bag, found as in a replay if None.
        start, duration: Part of the bag, s from its first message.
        wait: How long to wait for subscribers, s.
        namespace: Of the topics published on.
        remap: Other names for them, each ``FROM:=TO`` as after ``-r`` of a node.
        domain_id: ROS domain, that of the environment if None.
        progress: Called with the seconds of the bag that are played and those to play.

    Raises:
        BagError: the bag cannot be read or its topics are not clear.
        PlayError: ROS 1 bag, rate not positive and finite, no subscriber in time.
        ReplayError: the part lies outside the bag.
    """
    if not 0.0 < rate < math.inf:
        msg = f"rate {rate:g} is not positive and finite"
        raise PlayError(msg)
    path = Path(bag)
    if ".bag" in path.suffixes or (path.is_dir() and any(path.glob("*.bag*"))):
        msg = f"{path} is a ROS 1 bag: replay it offline, or convert it to play it to ROS 2"
        raise PlayError(msg)
    context = Context()
    part = Stream(start=start, duration=duration)
    with Bag(path) as source:
        names = _names(source, scan_topic, pose_topic)
        part.limit(source)
        # Not our own options, of which --remap's look like ROS's of old.
        ours = sys.argv.index("--ros-args") if "--ros-args" in sys.argv else len(sys.argv)
        rclpy.init(args=sys.argv[ours:], context=context, domain_id=domain_id)
        try:
            node = player_node(context, namespace, remap, names.values())
            publishers = _publishers(node, names)
            needed = [p for recorded, p in publishers.items() if names[recorded] not in OPTIONAL]
            wait_for_subscribers(node, needed, wait)
            wishes = [recorded for recorded, name in names.items() if name in LANDING_TOPICS]
            messages: Iterable[RawMessage] = source.messages(
                list(names), part.start_ns, part.stop_ns
            )
            if wishes:
                before = source.messages(wishes, 0, part.start_ns)
                for message in before:
                    publishers[message.topic].publish(_plain(message.raw))
            with Keyboard() as keyboard:
                times = PlayTime(node, rate, clock=clock, pressed=keyboard.pressed)
                began = time.monotonic()
                sent = _send(_told(messages, part, progress), names, publishers, times)
                seconds = time.monotonic() - began
                times.shutdown()
            for publisher in publishers.values():
                publisher.wait_for_all_acked(Duration(seconds=5))
            counts = {name: sent[recorded] for recorded, name in names.items()}
            return PlayReport(
                counts.get(SCAN_TOPIC, 0),
                counts.get(POSE_TOPIC, 0) + counts.get(ODOMETRY_TOPIC, 0),
                seconds,
                tuple(source.losses),
                counts.get(MAP_TOPICS[0], 0),
            )
        finally:
            context.try_shutdown()


def _names(bag: Bag, scan_topic: str | None, pose_topic: str | None) -> dict[str, str]:
    """The topics of the bag to play, and the name under which each is published."""
    pairs = MapPairs.alone(bag) if scan_topic is None else None
    if pairs is not None:
        return dict(zip(pairs.topics, MAP_TOPICS, strict=True))
    poses, kind = choose_pose_topic(bag, pose_topic, "pose")
    names = {
        choose_topic(bag, scan_topic, SCAN_TOPIC, SCAN_TYPE, "--scan-topic"): SCAN_TOPIC,
        poses: ODOMETRY_TOPIC if kind == ODOMETRY_TYPE else POSE_TOPIC,
    }
    names |= {topic: f"/landing/{name}" for topic, name in landing_topics(bag).items()}
    if any((t.name, t.type) == (GIMBAL_TOPIC, GIMBAL_TYPE) for t in bag.topics):
        names[GIMBAL_TOPIC] = GIMBAL_TOPIC
    return names


def _told(
    messages: Iterable[RawMessage], part: Stream, progress: Callable[[float, float], None] | None
) -> Iterable[RawMessage]:
    """The same messages; ``progress`` hears of them now and then."""
    shown = -math.inf
    for message in messages:
        yield message
        if progress is not None and time.monotonic() - shown > BAR_S:
            shown = time.monotonic()
            progress((message.received_ns - part.start_ns) / SECOND_NS, part.seconds)


def _send(
    messages: Iterable[RawMessage],
    names: Mapping[str, str],
    publishers: Mapping[str, Publisher],
    times: PlayTime,
) -> dict[str, int]:
    counts = dict.fromkeys(publishers, 0)
    newest = {name: 0 for name in names.values() if name not in LANDING_TOPICS}
    scans = SCAN_TOPIC in newest
    for topic, received_ns, raw in messages:
        # A scan that waits for the pose after it during a pause would be dropped by the node.
        served = not scans or min(newest.values()) == newest[SCAN_TOPIC]
        times.wait_until(received_ns, may_pause=served)
        raw = _plain(raw)
        publishers[topic].publish(raw)
        counts[topic] += 1
        if names[topic] in newest:
            newest[names[topic]] = max(newest[names[topic]], _stamp_ns(raw))
    return counts


def _plain(raw: Any) -> bytes:
    """A message as it is serialised, whether or not the bag compresses each."""
    if raw[:4] == ZSTD_MAGIC:
        raw = zstandard.ZstdDecompressor().decompressobj().decompress(raw)
    return bytes(raw)


def _stamp_ns(raw: Any) -> int:
    """Stamp of a serialised message that begins with its header; 0 if it is cut short."""
    if len(raw) < 12:
        return 0
    order = "<" if raw[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", raw, 4)
    return int(seconds) * SECOND_NS + int(nanoseconds)


def _publishers(node: Node, names: Mapping[str, str]) -> dict[str, Publisher]:
    """For each topic of the bag the publisher of its messages."""
    return {
        recorded: node.create_publisher(
            KINDS[name],
            name.lstrip("/"),
            latched() if name in (*MAP_TOPICS, *LANDING_TOPICS) else stream(DEPTH, reliable=True),
        )
        for recorded, name in names.items()
    }
