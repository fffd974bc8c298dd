# SPDX-License-Identifier: Apache-2.0
"""Selection of the topics of a bag to read: by name, else by type."""

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
"""Suffixes of topics with the type of an input that are outputs of our nodes or of guidance."""

MIN_COVERAGE, MIN_RATE, MIN_RATE_DEFAULT = 0.9, 0.5, 0.2
"""Limits below which a pose topic is not used, relative to the best topic: share of the scans
between two poses; rate, at most that of the scans; the same for a topic with a default name."""
CONVERSIONS = {
    "/PoseStamped": "copy PoseStamped into PoseWithCovarianceStamped with a covariance of zeros:"
    " docs/connecting.md has the script for a bag",
    "/CompressedPointCloud2": "play the bag through `ros2 run point_cloud_transport republish"
    " --ros-args -p out_transport:=raw -p in_transport:=draco` (or cloudini, zlib, zstd) and record"
    " its output",
    "/CustomMsg": "set xfer_format: 0 in livox_ros_driver2 to send PointCloud2; play a recording"
    " through the package livox_to_pointcloud2 and record its output",
    "/TFMessage": "if poses are only in /tf, record the odometry topic as well, or copy the"
    " transform of the body into PoseWithCovarianceStamped (docs/connecting.md, PoseStamped)",
    " as ": "only ROS messages are decoded; convert to ROS 2 messages (cdr)",
}
"""Fixes by part of the name of an unsupported type."""


def candidates(bag: Bag, kind: str, *, ours: bool = True) -> list[str]:
    """List the topics of an open bag with messages of a type; ``ours``: include `OUTPUTS`."""
    names = (topic.name for topic in bag.topics if topic.type == kind and topic.count)
    return [name for name in names if ours or not name.endswith(OUTPUTS)]


def choose_topic(
    bag: Bag,
    requested: str | None,
    default: str,
    option: str,
    msgtype: str = "",
    without: Collection[str] = (),
) -> str:
    """Choose the topic of ``msgtype`` (by default, of the default's type): the ``requested`` one,
    the ``default``, or the only one that is not in ``without``. Raises `BagError`, which lists the
    candidates and the command-line ``option``."""
    msgtype = msgtype or KINDS[default]
    matching = candidates(bag, msgtype, ours=requested is not None)
    if requested is not None:
        for name in (f"/{requested.lstrip('/')}", requested):
            if name in matching:
                return name
        listed = ", ".join(matching) or "none"
        msg = f"no {msgtype} on topic {requested}; candidates for {option}: {listed}"
        raise BagError(f"{bag.path}: {msg}")
    matching = [name for name in matching if name not in without]
    if default in matching or len(matching) == 1:
        return default if default in matching else matching[0]
    if matching:
        msg = f"several topics of type {msgtype}: choose one by {option}: {', '.join(matching)}"
        raise BagError(f"{bag.path}: {msg}")
    listed = ", ".join(f"{t.name} ({t.type}, {t.count})" for t in bag.topics) or "none"
    groups = (kinds for kinds in (types.SCAN_TYPES, types.POSE_TYPES) if msgtype in kinds)
    msg = f"no messages of type {' or '.join(next(groups, (msgtype,)))}; topics: {listed}"
    for part, fix in CONVERSIONS.items():
        if part == "/TFMessage" and msgtype not in types.POSE_TYPES:
            continue
        names = ", ".join(topic.name for topic in bag.topics if part in topic.type)
        msg += f"; {names}: {fix}" if names else ""
    raise BagError(f"{bag.path}: {msg}")


def choose_pose_topic(
    bag: Bag, requested: str | None, source: str, scans: str = ""
) -> tuple[str, str, str]:
    """Choose the poses; return topic, type and a note on the choice.

    ``source``: preferred type (``pose.source``). Topics with poses around too few of the ``scans``,
    or with a low rate compared to another topic, are not used. Raises `BagError`, which lists the
    candidates.
    """
    order = (ODOMETRY_TOPIC, POSE_TOPIC) if source == "odometry" else (POSE_TOPIC, ODOMETRY_TOPIC)
    if requested is not None:
        return *_choose(bag, requested, order, "--pose-topic"), ""
    names = [name for kind in order for name in candidates(bag, KINDS[kind], ours=False)]
    rates = _useful_rates(bag, names, scans)
    best = max((rate for _, rate in rates.values()), default=0.0)
    coverage = max((share for share, _ in rates.values()), default=0.0)
    unused = {
        name: rate
        for name, (share, rate) in rates.items()
        if share < MIN_COVERAGE * coverage
        or rate < (MIN_RATE_DEFAULT if name in order else MIN_RATE) * best
    }
    topic, kind = _choose(bag, None, order, "--pose-topic", unused)
    others = ", ".join(f"{name} ({rate:.2g} Hz)" for name, rate in unused.items())
    note = f"poses are taken from {topic}, not from {others}: --pose-topic chooses another"
    return topic, kind, note if others else ""


def _useful_rates(bag: Bag, names: list[str], scans: str) -> dict[str, tuple[float, float]]:
    """Return for each topic the share of the scans between two poses at most `GAP_NS` apart, and
    the rate, at most that of the scans, Hz, by times of reception; empty for a single topic."""
    if len(names) < 2:
        return {}
    times: dict[str, list[int]] = {name: [] for name in (*names, scans)}
    for message in bag.messages(list(times)):
        times[message.topic].append(message.received_ns)
    scan_times, found = np.sort(times[scans]), {}
    seconds = max(bag.end_ns - bag.start_ns, 1) * 1e-9
    for name in names:
        own = np.sort(times[name])
        after = np.searchsorted(own, scan_times)
        inside = (after > 0) & (after < len(own))
        near = own[after[inside]] - own[after[inside] - 1] <= GAP_NS
        rate = min(len(own), len(scan_times)) / seconds
        found[name] = np.count_nonzero(near) / max(len(scan_times), 1), rate
    return found


def choose_scan_topic(bag: Bag, requested: str | None, source: str) -> tuple[str, str, str]:
    """Choose the scans; return topic, type, and the CameraInfo topic of depth images, else empty.
    ``source``: preferred type (``lidar.source``). Raises `BagError`, which lists the candidates."""
    order = (DEPTH_TOPIC, SCAN_TOPIC) if source == "depth" else (SCAN_TOPIC, DEPTH_TOPIC)
    topic, kind = _choose(bag, requested, order, "--scan-topic", _without_depth(bag))
    if kind == types.SCAN_TYPE:
        return topic, kind, ""
    beside = topic.rpartition("/")[0] + "/camera_info"
    return topic, kind, choose_topic(bag, None, beside, "the CameraInfo", types.CAMERA_TYPE)


def _without_depth(bag: Bag) -> list[str]:
    """List topics of colour or infrared images by their first message, if there are several."""
    names, others = candidates(bag, types.IMAGE_TYPE), []
    for name in names if len(names) > 1 else []:
        with contextlib.suppress(MessageError, StopIteration):
            first = bag.decode(next(iter(bag.messages([name]))).raw, types.IMAGE_TYPE)
            others += [name] * (first.encoding not in ENCODINGS)
    return others


def _choose(
    bag: Bag,
    requested: str | None,
    order: tuple[str, str],
    option: str,
    without: Collection[str] = (),
) -> tuple[str, str]:
    """Choose the first type of two default topics that the bag has, or that of ``requested``."""

    def fits(kind: str) -> bool:
        found = {*candidates(bag, kind, ours=requested is not None)} - {*without}
        return bool(found if requested is None else found & {requested, f"/{requested}"})

    default = next((name for name in order if fits(KINDS[name])), order[0])
    return choose_topic(bag, requested, default, option, without=without), KINDS[default]


def landing_topics(bag: Bag, *, without: tuple[str, ...] = ()) -> dict[str, str]:
    """Return the topics of an open bag for the names in `TYPES`, except those in ``without``, as
    name by topic. Raises `BagError`: several topics have the same ending and none is
    ``/landing/<name>``."""
    found = {}
    for name, kind in TYPES.items():
        plain = f"/landing/{name}"
        matching = [topic for topic in candidates(bag, kind) if topic.endswith(plain)]
        if name in without or not matching:
            continue
        if plain not in matching and len(matching) > 1:
            option = name.replace("_", "-")
            msg = f"{bag.path}: several topics of landing/{name}: {', '.join(matching)}; set"
            msg += f" the value by --{option}"
            raise BagError(msg)
        found[plain if plain in matching else matching[0]] = name
    return found
