# SPDX-License-Identifier: Apache-2.0
"""The topics of a bag to read: by name, else by type."""

from __future__ import annotations

import contextlib
from collections.abc import Collection

import numpy as np

from quadtree_lss.desk.bags import message_types as types
from quadtree_lss.desk.bags.bag import Bag, BagError
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.depth import ENCODINGS
from quadtree_lss.onboard.messages.intake import GAP_NS
from quadtree_lss.onboard.messages.landing_inputs import TYPES
from quadtree_lss.onboard.messages.outputs import TOPIC_TYPES

SCAN_TOPIC, POSE_TOPIC, GIMBAL_TOPIC = "/lidar/points", "/nav/pose", "/lidar/gimbal"
DEPTH_TOPIC, CAMERA_TOPIC = "/depth/image", "/depth/camera_info"
ODOMETRY_TOPIC, TRANSFORMS_TOPIC = "/nav/odometry", "/tf_static"
KINDS = {
    SCAN_TOPIC: types.SCAN_TYPE,
    DEPTH_TOPIC: types.IMAGE_TYPE,
    CAMERA_TOPIC: types.CAMERA_TYPE,
    POSE_TOPIC: types.POSE_TYPE,
    ODOMETRY_TOPIC: types.ODOMETRY_TYPE,
    GIMBAL_TOPIC: types.GIMBAL_TYPE,
    TRANSFORMS_TOPIC: types.TRANSFORMS_TYPE,
}
"""Message type by default name of the topic."""
OUTPUTS = (*(f"/{name}" for name in TOPIC_TYPES), "/landing/dispersion")
"""Ends of topics that have the type of an input but are outputs of our nodes or of guidance."""

COVERED, SELDOM, SELDOM_NAMED = 0.9, 0.5, 0.2
"""Share of the scans with poses around them, and rate up to that of the scans, also of a topic of
the nodes' name, of the most that any pose topic has: with less a topic is passed over."""
CONVERSIONS = {
    "/PoseStamped": "copy PoseStamped into PoseWithCovarianceStamped with a covariance of zeros:"
    " docs/connecting.md has the script for a bag",
    "/CompressedPointCloud2": "play the bag through `ros2 run point_cloud_transport republish"
    " --ros-args -p out_transport:=raw -p in_transport:=draco` (or cloudini, zlib, zstd) and record"
    " its output",
    "/CustomMsg": "livox_ros_driver2 sends PointCloud2 with xfer_format: 0; of a recording, play it"
    " through the package livox_to_pointcloud2 and record its output",
    "/TFMessage": "of poses only in /tf record the odometry topic as well, or copy the transform of"
    " the body into PoseWithCovarianceStamped as docs/connecting.md does with PoseStamped",
    " as ": "only ROS messages are decoded; convert to ROS 2 messages (cdr)",
}
"""Remedies by a part of a type that is not read."""


def candidates(bag: Bag, kind: str, *, ours: bool = True) -> list[str]:
    """Topics of an open bag with messages of a type; ``ours``: also `OUTPUTS`."""
    names = (topic.name for topic in bag.topics if topic.type == kind and topic.count)
    return [name for name in names if ours or not name.endswith(OUTPUTS)]


def choose_topic(
    bag: Bag,
    asked: str | None,
    default: str,
    option: str,
    msgtype: str = "",
    without: Collection[str] = (),
) -> str:
    """The topic of ``msgtype``, or of the default's type: the one ``asked`` for, the ``default``,
    or the only one that is not in ``without``. Raises `BagError`: names the candidates, and the
    command-line ``option`` that chooses."""
    msgtype = msgtype or KINDS[default]
    fitting = candidates(bag, msgtype, ours=asked is not None)
    if asked is not None:
        for name in (f"/{asked.lstrip('/')}", asked):
            if name in fitting:
                return name
        there = ", ".join(fitting) or "none"
        msg = f"no {msgtype} on topic {asked}; candidates for {option}: {there}"
        raise BagError(f"{bag.path}: {msg}")
    fitting = [name for name in fitting if name not in without]
    if default in fitting or len(fitting) == 1:
        return default if default in fitting else fitting[0]
    if fitting:
        msg = f"several topics of type {msgtype}: choose one by {option}: {', '.join(fitting)}"
        raise BagError(f"{bag.path}: {msg}")
    there = ", ".join(f"{t.name} ({t.type}, {t.count})" for t in bag.topics) or "none"
    alike = (kinds for kinds in (types.SCAN_TYPES, types.POSE_TYPES) if msgtype in kinds)
    msg = f"no messages of type {' or '.join(next(alike, (msgtype,)))}; topics: {there}"
    for part, remedy in CONVERSIONS.items():
        if part == "/TFMessage" and msgtype not in types.POSE_TYPES:
            continue
        names = ", ".join(topic.name for topic in bag.topics if part in topic.type)
        msg += f"; {names}: {remedy}" if names else ""
    raise BagError(f"{bag.path}: {msg}")


def choose_pose_topic(
    bag: Bag, asked: str | None, source: str, scans: str = ""
) -> tuple[str, str, str]:
    """Topic and type of the poses, and a note on the choice. ``source`` (``pose.source``) is the
    type preferred. Topics with poses at too few times of the ``scans``, or more seldom than scans
    while another has more, are passed over. Raises `BagError`: names the candidates."""
    order = (ODOMETRY_TOPIC, POSE_TOPIC) if source == "odometry" else (POSE_TOPIC, ODOMETRY_TOPIC)
    if asked is not None:
        return *_choose(bag, asked, order, "--pose-topic"), ""
    names = [name for kind in order for name in candidates(bag, KINDS[kind], ours=False)]
    rates = _useful_rates(bag, names, scans)
    best = max((rate for _, rate in rates.values()), default=0.0)
    most = max((share for share, _ in rates.values()), default=0.0)
    seldom = {
        name: rate
        for name, (share, rate) in rates.items()
        if share < COVERED * most or rate < (SELDOM_NAMED if name in order else SELDOM) * best
    }
    topic, kind = _choose(bag, None, order, "--pose-topic", seldom)
    passed = ", ".join(f"{name} ({rate:.2g} Hz)" for name, rate in seldom.items())
    note = f"poses are taken from {topic}, not from {passed}: --pose-topic chooses another"
    return topic, kind, note if passed else ""


def _useful_rates(bag: Bag, names: list[str], scans: str) -> dict[str, tuple[float, float]]:
    """For each topic, the share of the scans between two poses that are not too far apart, and the
    rate, 1/s, at most that of the scans, by times of reception; empty where there is no choice."""
    if len(names) < 2:
        return {}
    times: dict[str, list[int]] = {name: [] for name in (*names, scans)}
    for message in bag.messages(list(times)):
        times[message.topic].append(message.received_ns)
    asked, found = np.sort(times[scans]), {}
    seconds = max(bag.end_ns - bag.start_ns, 1) * 1e-9
    for name in names:
        own = np.sort(times[name])
        after = np.searchsorted(own, asked)
        inside = (after > 0) & (after < len(own))
        near = own[after[inside]] - own[after[inside] - 1] <= GAP_NS
        rate = min(len(own), len(asked)) / seconds
        found[name] = np.count_nonzero(near) / max(len(asked), 1), rate
    return found


def choose_scan_topic(bag: Bag, asked: str | None, source: str) -> tuple[str, str, str]:
    """Topic and type of the scans, ``source`` (``lidar.source``) preferred, and the topic of the
    CameraInfo of depth images, empty for clouds. Raises `BagError`: lists the candidates."""
    order = (DEPTH_TOPIC, SCAN_TOPIC) if source == "depth" else (SCAN_TOPIC, DEPTH_TOPIC)
    topic, kind = _choose(bag, asked, order, "--scan-topic", _without_depth(bag))
    if kind == types.SCAN_TYPE:
        return topic, kind, ""
    beside = topic.rpartition("/")[0] + "/camera_info"
    return topic, kind, choose_topic(bag, None, beside, "the CameraInfo", types.CAMERA_TYPE)


def _without_depth(bag: Bag) -> list[str]:
    """Topics of images that are colour or infrared, by the first of each, where there are more."""
    names, others = candidates(bag, types.IMAGE_TYPE), []
    for name in names if len(names) > 1 else []:
        with contextlib.suppress(MessageError, StopIteration):
            first = bag.decode(next(iter(bag.messages([name]))).raw, types.IMAGE_TYPE)
            others += [name] * (first.encoding not in ENCODINGS)
    return others


def _choose(
    bag: Bag, asked: str | None, order: tuple[str, str], option: str, without: Collection[str] = ()
) -> tuple[str, str]:
    """Of the types of two topics the first that is there, or that of the topic asked for."""

    def fits(kind: str) -> bool:
        there = {*candidates(bag, kind, ours=asked is not None)} - {*without}
        return bool(there if asked is None else there & {asked, f"/{asked}"})

    default = next((name for name in order if fits(KINDS[name])), order[0])
    return choose_topic(bag, asked, default, option, without=without), KINDS[default]


def landing_topics(bag: Bag, *, without: tuple[str, ...] = ()) -> dict[str, str]:
    """Names of `TYPES` by the topic of an open bag, except those in ``without``. Raises `BagError`:
    several topics end alike and none has the plain name."""
    found = {}
    for name, kind in TYPES.items():
        plain = f"/landing/{name}"
        there = [topic for topic in candidates(bag, kind) if topic.endswith(plain)]
        if name in without or not there:
            continue
        if plain not in there and len(there) > 1:
            option = name.replace("_", "-")
            msg = f"{bag.path}: several topics of landing/{name}: {', '.join(there)}; say which"
            msg += f" polygon or place holds by --{option}"
            raise BagError(msg)
        found[plain if plain in there else there[0]] = name
    return found
