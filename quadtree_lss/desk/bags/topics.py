# SPDX-License-Identifier: Apache-2.0
"""The topics of a bag to read: by name, else by type."""

from __future__ import annotations

from quadtree_lss.desk.bags import message_types as types
from quadtree_lss.desk.bags.bag import Bag, BagError
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

CONVERSIONS = {
    "/PoseStamped": "convert to PoseWithCovarianceStamped; zeros are an unknown covariance",
    "/CompressedPointCloud2": "decompress with `ros2 run point_cloud_transport republish`",
    "/CustomMsg": "convert with livox_to_pointcloud2, or record with xfer_format: 0",
    " as ": "only ROS messages are decoded; convert to ROS 2 messages (cdr)",
}
"""Remedies by a part of a type that is not read."""


def candidates(bag: Bag, kind: str, *, ours: bool = True) -> list[str]:
    """Topics of an open bag with messages of a type; ``ours``: also `OUTPUTS`."""
    names = (topic.name for topic in bag.topics if topic.type == kind and topic.count)
    return [name for name in names if ours or not name.endswith(OUTPUTS)]


def choose_topic(bag: Bag, asked: str | None, default: str, option: str, msgtype: str = "") -> str:
    """Choose the topic ``asked`` for, else the ``default``, else the only one of ``msgtype`` (by
    default that of ``default``). Raises `BagError`: names candidates and the ``option``."""
    msgtype = msgtype or KINDS[default]
    fitting = candidates(bag, msgtype, ours=asked is not None)
    listed = ", ".join(fitting)
    if asked is not None:
        for name in (asked if asked.startswith("/") else f"/{asked}", asked):
            if name in fitting:
                return name
        msg = f"no {msgtype} on topic {asked}; candidates for {option}: {listed or 'none'}"
    elif default in fitting:
        return default
    elif len(fitting) == 1:
        return fitting[0]
    elif fitting:
        msg = f"several topics of type {msgtype}: choose one by {option}: {listed}"
    else:
        there = ", ".join(f"{t.name} ({t.type}, {t.count})" for t in bag.topics) or "none"
        alike = (kinds for kinds in (types.SCAN_TYPES, types.POSE_TYPES) if msgtype in kinds)
        kinds = " or ".join(next(alike, (msgtype,)))
        msg = f"no messages of type {kinds}; topics: {there}"
        for part, remedy in CONVERSIONS.items():
            names = ", ".join(topic.name for topic in bag.topics if part in topic.type)
            msg += f"; {names}: {remedy}" if names else ""
    raise BagError(f"{bag.path}: {msg}")


def choose_pose_topic(bag: Bag, asked: str | None, source: str) -> tuple[str, str]:
    """Topic and type of the poses; ``source`` (``pose.source``) is the preferred type. Raises
    `BagError`: lists the candidates."""
    order = (ODOMETRY_TOPIC, POSE_TOPIC) if source == "odometry" else (POSE_TOPIC, ODOMETRY_TOPIC)
    return _choose(bag, asked, order, "--pose-topic")


def choose_scan_topic(bag: Bag, asked: str | None, source: str) -> tuple[str, str, str]:
    """Topic and type of the scans, ``source`` (``lidar.source``) preferred, and the topic of the
    CameraInfo of depth images, empty for clouds. Raises `BagError`: lists the candidates."""
    order = (DEPTH_TOPIC, SCAN_TOPIC) if source == "depth" else (SCAN_TOPIC, DEPTH_TOPIC)
    topic, kind = _choose(bag, asked, order, "--scan-topic")
    if kind == types.SCAN_TYPE:
        return topic, kind, ""
    beside = topic.rpartition("/")[0] + "/camera_info"
    return topic, kind, choose_topic(bag, None, beside, "the CameraInfo", types.CAMERA_TYPE)


def _choose(bag: Bag, asked: str | None, order: tuple[str, str], option: str) -> tuple[str, str]:
    """Choose between the types of two topics: that of the topic asked for, else the first that is
    recorded."""

    def fits(kind: str) -> bool:
        there = {*candidates(bag, kind, ours=asked is not None)}
        return bool(there if asked is None else there & {asked, f"/{asked}"})

    default = next((name for name in order if fits(KINDS[name])), order[0])
    return choose_topic(bag, asked, default, option), KINDS[default]


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
