# SPDX-License-Identifier: Apache-2.0
"""Reading ROS 2 and ROS 1 bags as a stream of raw messages, whatever their state.

A bag is a list of files (`parts`). What could not be read stands in ``Bag.losses``.
"""

from __future__ import annotations

import difflib
import heapq
import tempfile
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quadtree_lss.desk.replay.parts import Part, of_one_time
from quadtree_lss.desk.replay.records import ZSTD_MAGIC, RawMessage
from quadtree_lss.desk.replay.types import (
    GIMBAL_TYPE,
    ODOMETRY_TYPE,
    POSE_TYPE,
    POSE_TYPES,
    SCAN_TYPE,
    TRANSFORMS_TYPE,
    typestore,
)
from quadtree_lss.desk.replay.unpack import MOST_BYTES, file_inside, unpack, unpack_file
from quadtree_lss.onboard.config import yaml_text
from quadtree_lss.onboard.config.yaml_text import YamlError, parse_yaml
from quadtree_lss.onboard.errors import QuadtreeLssError, one_line
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.outputs import TOPIC_TYPES

__all__ = [
    "GIMBAL_TOPIC",
    "GIMBAL_TYPE",
    "ODOMETRY_TOPIC",
    "ODOMETRY_TYPE",
    "POSE_TOPIC",
    "POSE_TYPE",
    "POSE_TYPES",
    "SCAN_TOPIC",
    "SCAN_TYPE",
    "TRANSFORMS_TOPIC",
    "TRANSFORMS_TYPE",
    "Bag",
    "BagError",
    "Topic",
    "choose_pose_topic",
    "choose_topic",
]

SCAN_TOPIC, POSE_TOPIC, GIMBAL_TOPIC = "/lidar/points", "/nav/pose", "/lidar/gimbal"
ODOMETRY_TOPIC, TRANSFORMS_TOPIC = "/nav/odometry", "/tf_static"

OUTPUTS = (*(f"/{name}" for name in TOPIC_TYPES), "/landing/dispersion")
"""How topics end that are clouds or poses by type, but our own output or what guidance says."""


class BagError(QuadtreeLssError):
    """A bag cannot be used at all, or it is not clear which topics are meant."""


@dataclass(frozen=True)
class Topic:
    """A recorded topic: name, type as in ``sensor_msgs/msg/PointCloud2``, number of messages."""

    name: str
    type: str
    count: int


class Bag:
    """Context manager that opens a bag for reading.

    Args:
        path: rosbag2 directory (mcap or sqlite3, also without its metadata), a single ``.mcap``,
            ``.db3`` or ROS 1 ``.bag`` file; each also compressed with zstd.

    Raises:
        BagError: there is nothing to read.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._stack = ExitStack()
        self._parts: list[Part] = []
        self._losses: list[str] = []

    def __enter__(self) -> Bag:
        try:
            self._open()
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def topics(self) -> list[Topic]:
        """Recorded topics by name."""
        types: dict[str, str] = {}
        counts: dict[str, int] = {}
        for part in self._parts:
            for name, kind in part.extent.types.items():
                types[name] = kind
                counts[name] = counts.get(name, 0) + part.extent.counts.get(name, 0)
        return [Topic(name, types[name], counts[name]) for name in sorted(types)]

    @property
    def start_ns(self) -> int:
        """Time of reception of the first message of any topic."""
        return min(part.extent.start_ns for part in self._parts)

    @property
    def end_ns(self) -> int:
        """Time of reception of the last message of any topic."""
        return max(part.extent.end_ns for part in self._parts)

    @property
    def losses(self) -> list[str]:
        """One line for each piece that could not be read, so far."""
        lines = self._losses + [loss for part in self._parts for loss in part.losses]
        return [one_line(line) for line in lines]

    @property
    def notes(self) -> list[str]:
        """What to know of the recording, one line each."""
        return [one_line(note) for part in self._parts for note in part.notes]

    def messages(
        self, topics: Collection[str], start_ns: int = 0, stop_ns: int = 2**63 - 1
    ) -> Iterator[RawMessage]:
        """Raw messages of the topics with start_ns <= time of reception < stop_ns.

        One file after the other, as they were recorded; files of one time, such as one per topic,
        are joined by the time of reception.
        """
        for parts in of_one_time(self._parts):
            streams = [
                part.messages(topics, start_ns, stop_ns)
                for part in parts
                if part.extent.start_ns < stop_ns and part.extent.end_ns >= start_ns
            ]
            yield from heapq.merge(*streams, key=lambda message: message.received_ns)

    def decode(self, raw: bytes, msgtype: str) -> Any:
        """The message of which ``raw`` are the serialised bytes.

        Raises:
            MessageError: ``encoding`` if they are not.
        """
        try:
            if raw[:4] == ZSTD_MAGIC:  # bags compressed message by message
                raw = unpack("zstd", raw, MOST_BYTES)
            content = memoryview(raw)  # of which slices are no copies
            if self._ros1:
                return self._store.deserialize_ros1(content, msgtype)
            return self._store.deserialize_cdr(content, msgtype)
        except Exception as error:  # any content must do: SerdeError, struct.error, ValueError, …
            text = f"{msgtype} cannot be decoded: {_line(error)}"
            raise MessageError("encoding", text) from None

    def _open(self) -> None:
        if not self.path.exists():
            msg = f"no such bag: {self.path}{likely_bag(self.path)}"
            raise BagError(msg)
        try:
            files = self._files()
            for file in files:
                part = Part(self._plain(file))
                self._parts.append(part)
        except PermissionError as error:
            msg = f"{error.filename}: {error.strerror}"
            raise BagError(msg) from None
        used = [part for part in self._parts if sum(part.extent.counts.values())]
        if not used:
            lost = "; ".join(self.losses) or "it is empty"
            msg = f"{self.path}: no message can be read: {lost}"
            raise BagError(msg)
        self._losses += [loss for p in self._parts if p not in used for loss in p.losses]
        self._parts = used
        self._ros1 = used[0].ros1
        self._store = typestore(self._ros1, {topic.type for topic in self.topics})

    def _files(self) -> list[Path]:
        if self.path.is_file():
            if _storage_suffix(self.path) is None:
                msg = f"{self.path}: not a bag (.mcap, .db3, .bag, or a folder of these)"
                raise BagError(msg)
            return [self.path]
        there = sorted(p for p in self.path.iterdir() if _storage_suffix(p) is not None)
        try:
            with open(self.path / "metadata.yaml", encoding="utf-8") as file:
                content: Any = parse_yaml(file.read(yaml_text.MOST_BYTES + 1), aliases=True)
            names = content["rosbag2_bagfile_information"]["relative_file_paths"]
            listed = [self.path / Path(name).name for name in names]
        except FileNotFoundError:
            self._losses.append("metadata.yaml is missing: was the recording cut off?")
            listed = there
        except (OSError, ValueError, KeyError, TypeError, YamlError):
            self._losses.append("metadata.yaml cannot be read")
            listed = there
        self._losses += [f"{p.name} is missing" for p in listed if not p.exists()]
        files = [p for p in listed if p.exists()]
        if not files:
            msg = f"{self.path}: no bag: there is no .mcap, .db3 or .bag in it"
            raise BagError(msg + likely_bag(self.path))
        return files

    def _plain(self, file: Path) -> Path:
        """The file itself, or what is in it if it is compressed as a whole."""
        inside = file_inside(file)
        if inside is None:
            return file
        folder = self._stack.enter_context(tempfile.TemporaryDirectory(prefix="quadtree_lss_"))
        plain = Path(folder) / inside
        with open(file, "rb") as source, open(plain, "wb") as target:
            fault = unpack_file(source, target)
        if fault is not None:
            self._losses.append(f"{file.name}: {fault}")
        return plain


def _storage_suffix(path: Path) -> str | None:
    suffixes = [s for s in path.suffixes if s not in (".zstd", ".zst")]
    return suffixes[-1] if suffixes and suffixes[-1] in (".mcap", ".db3", ".bag") else None


def likely_bag(path: Path) -> str:
    """``; did you mean flight/bag?``: bags inside a folder, or beside a name that is not there."""
    if path.is_dir():
        near = [p for p in _listing(path) if _holds_bag(p)]
    else:
        beside = {p.name: p for p in _listing(path.parent) if _holds_bag(p)}
        names = difflib.get_close_matches(path.name, beside, n=1)
        near = [beside[name] for name in names]
    if not near:
        return ""
    more = f" (or one of {len(near) - 3} more)" if len(near) > 3 else ""
    return f"; did you mean {' or '.join(map(str, near[:3]))}{more}?"


def _holds_bag(path: Path) -> bool:
    if path.is_dir():
        return any(p.is_file() and _storage_suffix(p) is not None for p in _listing(path))
    return _storage_suffix(path) is not None


def _listing(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


def _line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]


def choose_topic(bag: Bag, asked: str | None, default: str, msgtype: str, option: str) -> str:
    """The topic of a type to read: the one asked for, else the default, else the only one.

    Args:
        bag: An open bag.
        asked: What the user named, or None.
        default: Taken if present.
        msgtype: Type the topic must have.
        option: Command-line option by which the user can choose, for messages.

    Raises:
        BagError: lists the candidates.
    """
    fitting = [t.name for t in bag.topics if t.type == msgtype and t.count]
    if asked is None:
        fitting = [name for name in fitting if not name.endswith(OUTPUTS)]
    candidates = ", ".join(fitting) or "none"
    if asked is not None:
        name = asked if asked.startswith("/") else f"/{asked}"
        if name in fitting:
            return name
        if asked in fitting:
            return asked
        msg = f"{bag.path}: no {msgtype} on topic {asked}; candidates for {option}: {candidates}"
        raise BagError(msg)
    if default in fitting:
        return default
    if len(fitting) == 1:
        return fitting[0]
    if not fitting:
        there = ", ".join(f"{t.name} ({t.type}, {t.count})" for t in bag.topics) or "none"
        msg = f"{bag.path}: no messages of type {msgtype}; topics: {there}"
        raise BagError(msg)
    msg = f"{bag.path}: several topics of type {msgtype}: choose one by {option}: {candidates}"
    raise BagError(msg)


def choose_pose_topic(bag: Bag, asked: str | None, source: str) -> tuple[str, str]:
    """Topic and type of the poses: of the type preferred, of the other if there is none of it.

    Args:
        bag: An open bag.
        asked: Topic that the user named, or None.
        source: ``pose`` or ``odometry``, as ``pose.source`` has it.

    Raises:
        BagError: lists the candidates.
    """
    kinds = [(POSE_TOPIC, POSE_TYPE), (ODOMETRY_TOPIC, ODOMETRY_TYPE)]
    if source == "odometry":
        kinds.reverse()
    names = set() if asked is None else {asked, f"/{asked}"}
    for default, kind in kinds:
        there = [t.name for t in bag.topics if t.type == kind and t.count]
        if asked is None:
            there = [name for name in there if not name.endswith(OUTPUTS)]
        if there and (asked is None or names & set(there)):
            return choose_topic(bag, asked, default, kind, "--pose-topic"), kind
    return choose_topic(bag, asked, kinds[0][0], kinds[0][1], "--pose-topic"), kinds[0][1]
