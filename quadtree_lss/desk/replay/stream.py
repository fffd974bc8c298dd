# SPDX-License-Identifier: Apache-2.0
"""Input of a replay: scans and poses, areas and targets, or maps, of a part of a bag."""

from __future__ import annotations

import contextlib
import math
import time
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from quadtree_lss.desk.bags import message_types as types
from quadtree_lss.desk.bags import topics
from quadtree_lss.desk.bags.bag import Bag
from quadtree_lss.desk.bags.recorded_file import RawMessage
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import Config, LssConfig, MountConfig, config_from_values
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.transforms import FixedTransforms
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.errors import OutsideInput, one_line
from quadtree_lss.onboard.messages import outputs
from quadtree_lss.onboard.messages.clouds import MessageError, stamp_ns
from quadtree_lss.onboard.messages.extrinsics import add_transforms
from quadtree_lss.onboard.messages.intake import Intake, Notice, ReadyScan
from quadtree_lss.onboard.messages.landing_inputs import TYPES, LandingRequests
from quadtree_lss.onboard.messages.poses import mount_from_message

SECOND_NS = 1_000_000_000
PROGRESS_S = 0.2
"""Interval of calls of a `Progress`, s."""
Progress = Callable[[float, float], None]
"""Callback with the processed and the total seconds of the bag."""


def rate(times_ns: Sequence[int]) -> float:
    """Return the rate of stamps, Hz; NaN if all are equal."""
    length = (max(times_ns, default=0) - min(times_ns, default=0)) / SECOND_NS
    return (len(times_ns) - 1) / length if length > 0.0 else math.nan


class Selection(NamedTuple):
    """Topics of a bag to read, by default found by name, then by type, from ``start`` s after the
    first message, for ``duration`` s or until the end."""

    scan_topic: str | None = None
    pose_topic: str | None = None
    start: float = 0.0
    duration: float | None = None


class Part(NamedTuple):
    """Messages of a bag with start_ns <= time of reception < stop_ns, which span ``seconds``."""

    start_ns: int
    stop_ns: int
    seconds: float

    @classmethod
    def of(cls, bag: Bag, start: float = 0.0, duration: float | None = None) -> Part:
        """Make a part that begins ``start`` s after the first message of an open bag and lasts
        ``duration`` s or until the end. Raises `OutsideInput`: it lies outside the bag."""
        length = (bag.end_ns - bag.start_ns) / SECOND_NS
        if not 0.0 <= start <= length:
            raise OutsideInput(f"--start {start:g} s is outside the bag's {length:.3f} s")
        if duration is not None and not 0.0 < duration < math.inf:
            raise OutsideInput(f"--duration {duration:g} s is not positive and finite")
        first, end = bag.start_ns + round(start * SECOND_NS), bag.end_ns + 1
        if duration is not None:
            end = min(end, first + round(duration * SECOND_NS))
        return cls(first, end, (min(end, bag.end_ns) - first) / SECOND_NS)

    def messages(
        self, bag: Bag, topics: Collection[str], progress: Progress | None = None
    ) -> Iterator[RawMessage]:
        shown = -math.inf
        for message in bag.messages(topics, self.start_ns, self.stop_ns):
            yield message
            if progress is not None and time.monotonic() - shown > PROGRESS_S:
                shown = time.monotonic()
                progress((message.received_ns - self.start_ns) / SECOND_NS, self.seconds)


class Stream:
    """Feeds scans and poses of an open bag to an `Intake`, which joins them.

    ``scans``, ``poses`` and, unless empty, ``gimbal`` and ``camera`` (of depth images) are the
    topics read. ``on_message``: optional callback with the kind and the message. ``settings``:
    derived from the bag; ``mount.source: tf`` if no mount is set and ``/tf_static`` connects the
    poses' body with the scans; if ``adapt``, ``frames.map`` of the first pose. ``tf_mounts``:
    possible mounts, with the settings for them, by frame of the body, from ``/tf_static`` or else
    from the constant transforms of ``/tf``. Raises `BagError`: a topic is missing or ambiguous.
    """

    def __init__(
        self,
        bag: Bag,
        config: Config,
        scan_topic: str | None = None,
        pose_topic: str | None = None,
        *,
        adapt: bool = False,
    ) -> None:
        self._bag = bag
        self.on_message: Callable[[str, Any, RawMessage], None] | None = None
        source = config.lidar.source
        self.scans, self.scan_type, self.camera = topics.choose_scan_topic(bag, scan_topic, source)
        self.poses, self.pose_type, note = topics.choose_pose_topic(
            bag, pose_topic, config.pose.source, self.scans
        )
        self.notes = [note] * bool(note)
        self.settings: dict[str, Any] = {}
        self.tf_mounts: dict[str, tuple[Pose, dict[str, Any]]] = {}
        transforms = topics.candidates(bag, types.TRANSFORMS_TYPE)
        mountable = bool(transforms) and config.mount == MountConfig()
        pose = None
        if adapt or mountable:
            pose = next(self._decoded([self.poses], self.pose_type), None)
        if adapt and pose is not None and pose.header.frame_id.strip("/"):
            frame = pose.header.frame_id.lstrip("/")
            self.settings |= {"frames.map": frame} if frame != config.frames.map else {}
        if mountable and pose is not None:
            self.settings |= self._find_tf_mounts(config, pose, transforms, adapt)
        config = self.config = config_from_values(self.settings, config)
        self.gimbal = ""
        if config.mount.source == "gimbal":
            self.gimbal = topics.choose_topic(bag, None, topics.GIMBAL_TOPIC, "mount.source gimbal")
        names = {"scan_topic": self.scans, "pose_topic": self.poses}
        self.intake = Intake(config, **names, gimbal_topic=self.gimbal or topics.GIMBAL_TOPIC)
        if config.mount.source == "tf":
            # These are latched: read them before the scans.
            topic = topics.choose_topic(bag, None, topics.TRANSFORMS_TOPIC, "mount.source tf")
            for msg in self._decoded([topic], types.TRANSFORMS_TYPE):
                self.intake.on_transforms(msg)
        self._handlers: dict[str, tuple[str, str, Callable[..., object]]] = {
            self.camera: ("camera", types.CAMERA_TYPE, self.intake.on_camera_info),
            self.gimbal: ("gimbal", types.GIMBAL_TYPE, self.intake.on_gimbal),
            self.poses: ("pose", self.pose_type, self.intake.on_pose),
            self.scans: ("cloud", self.scan_type, self.intake.on_cloud),
        }
        self.topics = [name for name in self._handlers if name]
        self._stamps: dict[str, list[int]] = {}
        self._undecoded: dict[str, list[str]] = {}

    def _decoded(self, names: Collection[str], kind: str) -> Iterator[Any]:
        """Yield the messages of topics that can be decoded."""
        for message in self._bag.messages(names):
            with contextlib.suppress(MessageError):
                yield self._bag.decode(message.raw, kind)

    def _find_tf_mounts(
        self, config: Config, pose: Any, transforms: list[str], adapt: bool
    ) -> dict[str, Any]:
        """Fill ``tf_mounts``; return the setting that uses ``/tf_static``, empty if it has no mount
        or a zero one. ``pose``: the first one. ``adapt``: also use ``/tf``."""
        scan = next(self._decoded([self.scans], self.scan_type), None)
        if scan is None:
            return {}
        tree, lidar = FixedTransforms(), scan.header.frame_id
        static = [name for name in transforms if name.endswith(topics.TRANSFORMS_TOPIC)]
        for msg in self._decoded(static, types.TRANSFORMS_TYPE):
            with contextlib.suppress(MessageError):
                add_transforms(tree, msg)
        body = config.frames.body or getattr(pose, "child_frame_id", "")
        for name, mount in _mounts(tree, config, body, lidar):
            self.tf_mounts[name] = mount, {"mount.source": "tf", "frames.body": name}
        if body and self.tf_mounts and len(static) == 1:
            text = f"poses are of '{body}', scans of '{lidar}': the mount is taken from {static[0]}"
            self.notes.append(one_line(f"{text}; the nodes need mount.source: tf"))
            return {"mount.source": "tf"}
        if adapt and not self.tf_mounts:
            for link in self._constant_transforms([t for t in transforms if t not in static]):
                tree.add(*link)
            known = lidar.lstrip("/") in tree.frames()
            for frame in [lidar] if known else tree.frames() if body else []:
                for name, mount in _mounts(tree, config, body, frame):
                    text = name if known else f"{name}' and scans of '{frame}"
                    values = mount_values(mount.position, mount.rotation_map_lidar)
                    self.tf_mounts[text] = mount, values
        return {}

    def _constant_transforms(self, names: list[str]) -> list[tuple[str, str, Pose]]:
        """Return parent, child and pose of the transforms on topics that do not change."""
        tree = FixedTransforms()
        links: dict[tuple[str, str], Pose] = {}
        moving: set[tuple[str, str]] = set()
        for item in (i for m in self._decoded(names, types.TRANSFORMS_TYPE) for i in m.transforms):
            frames = item.header.frame_id, item.child_frame_id
            with contextlib.suppress(MessageError):
                pose = mount_from_message(item)
                if tree.add(*frames, pose):
                    moving.update({frames} & links.keys())
                    links.setdefault(frames, pose)
        return [(*frames, pose) for frames, pose in links.items() if frames not in moving]

    def ready(self, part: Part, progress: Progress | None = None) -> Iterator[ReadyScan]:
        """Yield the scans of a part of the bag, each with the lidar's pose at its stamp."""
        for message in part.messages(self._bag, self.topics, progress):
            self.process(message)
            yield from self.intake.ready(message.received_ns)

    def process(self, message: RawMessage) -> int | None:
        """Pass a message to the intake; return the stamp if it is a usable scan."""
        what, kind, handle = self._handlers[message.topic]
        try:
            msg = self._bag.decode(message.raw, kind)
        except MessageError as error:
            self.intake.reject(what, error)
            self._undecoded.setdefault(message.topic, []).append(str(error))
            return None
        with contextlib.suppress(MessageError):  # the intake counts it
            self._stamps.setdefault(message.topic, []).append(stamp_ns(msg.header))
        if self.on_message is not None:
            self.on_message(what, msg, message)
        if what == "cloud":
            return self.intake.on_cloud(msg, message.received_ns)
        handle(msg)
        return None

    @property
    def losses(self) -> list[str]:
        """One line for each topic with messages that could not be decoded."""
        return [
            one_line(f"{len(texts)} messages of {topic} lost: {texts[0]}")
            for topic, texts in self._undecoded.items()
        ]

    def counts(self) -> dict[str, Any]:
        """Return entries of ``summary.json``."""
        return {
            "scan_topic": self.scans,
            "pose_topic": self.poses,
            "scan_rate": rate(self._stamps.get(self.scans, ())),
            "pose_rate": rate(self._stamps.get(self.poses, ())),
            "scans_dropped": dict(self.intake.dropped),
            "poses": self.intake.poses_taken,
            "messages_rejected": dict(self.intake.rejected),
        }


def _mounts(
    tree: FixedTransforms, config: Config, body: str, lidar: str
) -> Iterator[tuple[str, Pose]]:
    """Yield the body's frame and the mount for each possible mount of a tree, except the identity.
    ``body``: if empty, any frame can be the body."""
    for name in [body.lstrip("/")] if body else sorted({*tree.frames()} - {config.frames.map}):
        mount = tree.relative_pose(name, lidar)
        if mount is not None:
            position, rotation = mount.position, mount.rotation_map_lidar
            if not (np.allclose(position, 0.0) and np.allclose(rotation, np.eye(3), atol=1e-6)):
                yield name, mount


def mount_values(position: Array, rotation: Array, digits: int = 3) -> dict[str, Any]:
    """Return the parameters of a fixed mount, angles rounded to ``digits``."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # at a pitch of 90 deg yaw is set to 0
        angles = np.round(Rotation.from_matrix(rotation).as_euler("xyz", degrees=True), digits)
    angles = np.where(angles == -180.0, 180.0, angles) + 0.0
    names = ("x", "y", "z", "roll_deg", "pitch_deg", "yaw_deg")
    values = (*np.round(position, 4).tolist(), *angles.tolist())
    return {f"mount.{name}": value for name, value in zip(names, values, strict=True)}


class LandingTopics:
    """Feeds `LandingRequests` from an open bag, except fixed names. Messages before ``start_ns``
    are used at once, because these topics are latched."""

    def __init__(self, requests: LandingRequests, bag: Bag, start_ns: int) -> None:
        self.requests = requests
        self.names = topics.landing_topics(bag, without=tuple(requests.fixed))
        self.notices: list[Notice] = []
        if self.names:
            for message in bag.messages(list(self.names), 0, start_ns):
                self.process(bag, message)

    def process(self, bag: Bag, message: RawMessage) -> bool:
        """Use a message of these topics; return False for others."""
        name = self.names.get(message.topic)
        if name is None:
            return False
        msg = None
        try:
            msg = bag.decode(message.raw, TYPES[name])
            self.requests.use_message(name, msg)
        except MessageError as error:
            if msg is None:
                self.requests.mark_unusable(name, error)
            self.notices.append(Notice(f"{name}_{error.reason}", f"landing/{name}: {error}"))
        return True


class MapPairs:
    """Joins ``map/cells`` and ``map/observed`` of one stamp to a map, in any namespace."""

    def __init__(self, cells_topic: str, observed_topic: str) -> None:
        self.topics = (cells_topic, observed_topic)
        self._last: dict[str, Any] = {}

    @classmethod
    def of_maps_only(cls, bag: Bag, scan_topic: str | None = None) -> MapPairs | None:
        """Find the map topics of an open bag without scans; None if it has scans or no maps."""
        if scan_topic is not None:
            return None
        clouds = topics.candidates(bag, types.SCAN_TYPE)
        grids = topics.candidates(bag, outputs.GRID_TYPE)
        for name in clouds:
            prefix = name.removesuffix(outputs.CELLS)
            if name.endswith(f"/{outputs.CELLS}") and prefix + outputs.OBSERVED in grids:
                own_clouds = (outputs.CELLS, outputs.SITE_TABLE, outputs.STATUS)
                others = set(clouds) - {prefix + own for own in own_clouds}
                return None if others else cls(name, prefix + outputs.OBSERVED)
        return None

    def add(self, bag: Bag, message: RawMessage, lss: LssConfig | None = None) -> CellMap | None:
        """Add a message; return the map that it completes, else None. ``lss``: as in
        `decode_cells`. Raises `MessageError`: not a message of ``mapping_node``."""
        kind = types.SCAN_TYPE if message.topic == self.topics[0] else outputs.GRID_TYPE
        self._last[message.topic] = bag.decode(message.raw, kind)
        cells, observed = (self._last.get(topic) for topic in self.topics)
        if not cells or not observed or stamp_ns(cells.header) != stamp_ns(observed.header):
            return None
        self._last.clear()
        return outputs.map_from_messages(cells, observed, lss)
