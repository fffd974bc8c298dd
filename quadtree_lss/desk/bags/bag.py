# SPDX-License-Identifier: Apache-2.0
"""ROS 2 and ROS 1 bags as a stream of raw messages.

rosbags only decodes messages, because its readers reject truncated files, decompress without a
limit, and sort by time even if the recorder's clock stepped back.
"""

from __future__ import annotations

import heapq
import re
import tempfile
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from quadtree_lss.desk.bags.chunked_file import McapFile, Ros1File
from quadtree_lss.desk.bags.compression import plain_message, unpack_file
from quadtree_lss.desk.bags.message_types import typestore
from quadtree_lss.desk.bags.recorded_file import LAST_NS, RawMessage, RecordedFile
from quadtree_lss.desk.bags.sqlite_file import SqliteFile
from quadtree_lss.onboard.config.yaml_text import MAX_YAML_BYTES, YamlError, parse_yaml
from quadtree_lss.onboard.errors import QuadtreeLssError, one_line
from quadtree_lss.onboard.messages.clouds import MessageError

FORMATS: dict[str, type[RecordedFile]] = {".mcap": McapFile, ".db3": SqliteFile, ".bag": Ros1File}
COMPRESSED = (".zstd", ".zst")
"""Suffixes of files that are compressed as a whole."""


class BagError(QuadtreeLssError):
    """A bag cannot be used, or its topics are missing or ambiguous."""


@dataclass(frozen=True)
class Topic:
    """A recorded topic: name, type as in ``sensor_msgs/msg/PointCloud2``, number of messages."""

    name: str
    type: str
    count: int


class Bag:
    """Context manager that opens a bag: a rosbag2 folder (also without metadata) or a ``.mcap``,
    ``.db3`` or ROS 1 ``.bag`` file, each also compressed with zstd.

    ``topics`` are sorted by name, ``start_ns`` and ``end_ns`` are times of reception, ``notes`` are
    one line each. Raises `BagError`: there is nothing to read.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.topics: list[Topic] = []
        self.start_ns = self.end_ns = 0
        self.notes: list[str] = []
        self._stack = ExitStack()
        self._files: list[RecordedFile] = []
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
    def losses(self) -> list[str]:
        """One line for each part that could not be read so far."""
        lines = self._losses + [loss for file in self._files for loss in file.losses]
        return [one_line(line) for line in lines]

    def messages(
        self, topics: Collection[str], start_ns: int = 0, stop_ns: int = LAST_NS
    ) -> Iterator[RawMessage]:
        """Yield raw messages of the topics with start_ns <= time of reception < stop_ns.

        Files are read one after the other, because a clock may have stepped back; files without a
        common topic are merged by time.
        """
        groups: list[list[RecordedFile]] = []
        for file in self._files:
            common = (g for g in groups if any(file.counts.keys() & f.counts.keys() for f in g))
            if (group := next(common, None)) is None:
                groups.append(group := [])
            group.append(file)
        streams = ((m for f in g for m in f.messages(topics, start_ns, stop_ns)) for g in groups)
        return heapq.merge(*streams, key=lambda message: message.received_ns)

    def decode(self, raw: bytes, msgtype: str) -> Any:
        """Decode a message. Raises `MessageError` with reason ``encoding``."""
        try:
            return self._decoded(raw, msgtype)
        except Exception as error:  # SerdeError, struct.error, ValueError, …
            line = (str(error) or type(error).__name__).splitlines()[0]
            text = f"{msgtype} cannot be decoded: {line}"
            raise MessageError("encoding", text) from None

    def _decoded(self, raw: bytes, msgtype: str) -> Any:
        content = memoryview(plain_message(raw))  # slices without copying
        store = self._store
        return (store.deserialize_ros1 if self.ros1 else store.deserialize_cdr)(content, msgtype)

    def _open(self) -> None:
        if not self.path.exists():
            raise BagError(f"no such bag: {self.path}")
        try:
            for path in self._paths():
                plain = self._decompress(path) if path.suffix in COMPRESSED else path
                file = FORMATS[plain.suffix](plain)
                self._stack.callback(file.close)
                self._files.append(file)
        except PermissionError as error:
            raise BagError(f"{error.filename}: {error.strerror}") from None
        if not any(len(file.index) for file in self._files):
            lost = "; ".join(self.losses) or "it is empty"
            raise BagError(f"{self.path}: no message can be read: {lost}")
        types: dict[str, str] = {}
        counts: Counter[str] = Counter()
        for file in self._files:
            types |= dict(file.topics.values())
            counts.update(file.counts)
        self.topics = [Topic(name, types[name], counts[name]) for name in sorted(types)]
        self.start_ns = min(file.start_ns for file in self._files)
        self.end_ns = max(file.end_ns for file in self._files)
        notes = self.notes + [note for file in self._files for note in file.notes]
        self.notes = [one_line(note) for note in notes]
        self.ros1 = self._files[0].ros1
        self._store = typestore(self.ros1)

    def _paths(self) -> list[Path]:
        if self.path.is_file():
            if not _is_bag_file(self.path):
                raise BagError(f"{self.path}: not a bag (.mcap, .db3, .bag, or a folder of these)")
            return [self.path]
        available = _bag_files(self.path)
        files = list(available.values())
        try:
            with open(self.path / "metadata.yaml", encoding="utf-8") as file:
                content: Any = parse_yaml(file.read(MAX_YAML_BYTES + 1), yaml.SafeLoader)
            names = content["rosbag2_bagfile_information"]["relative_file_paths"]
            files = self._listed_files([Path(name).name for name in names], available)
        except FileNotFoundError:
            self.notes.append("metadata.yaml is missing: all bag files of the folder are read")
        except (OSError, ValueError, KeyError, TypeError, YamlError):
            self._losses.append("metadata.yaml cannot be read")
        if not files:
            folders = (p for p in sorted(self.path.iterdir()) if p.is_dir() and _bag_files(p))
            inner = ", ".join(path.name for path in folders)
            text = f"there is no .mcap, .db3 or .bag in it{f', but in {inner}' * bool(inner)}"
            raise BagError(f"{self.path}: not a bag: {text}")
        return files

    def _listed_files(self, names: list[str], available: dict[str, Path]) -> list[Path]:
        """Return the files that metadata.yaml lists, also if renamed or decompressed."""
        found = {name: available[_plain(name)] for name in names if _plain(name) in available}
        missing = [name for name in names if name not in found]
        others = [path for path in available.values() if path not in found.values()]
        if len(missing) == len(others):
            found |= dict(zip(missing, others, strict=True))
            self.notes += [f"{found[name].name} is read instead of {name}" for name in missing]
            missing = []
        if names and not found:
            raise BagError(
                f"{self.path}: not a bag: {', '.join(names)} of metadata.yaml is missing"
            )
        self._losses += [f"{name} is missing" for name in missing]
        return [found[name] for name in names if name in found]

    def _decompress(self, file: Path) -> Path:
        """Decompress a file that is compressed as a whole."""
        folder = self._stack.enter_context(tempfile.TemporaryDirectory(prefix="quadtree_lss_"))
        plain = Path(folder) / file.stem
        if fault := unpack_file(file, plain):
            self._losses.append(f"{file.name}: {fault}")
        return plain


class MessageBag(Bag):
    """A bag of given messages: (topic, time of reception, message or a function that returns it),
    in order of reception. ``name`` replaces the path in user messages; ``span_ns`` is the first and
    last time of reception."""

    def __init__(
        self,
        name: str,
        topics: Iterable[Topic],
        span_ns: tuple[int, int],
        messages: Iterable[tuple[str, int, Any]],
    ) -> None:
        super().__init__(Path(name))
        self.topics, self._messages = list(topics), messages
        self.start_ns, self.end_ns = span_ns

    def _open(self) -> None:
        return

    def messages(
        self, topics: Collection[str], start_ns: int = 0, stop_ns: int = LAST_NS
    ) -> Iterator[RawMessage]:
        for topic, received_ns, message in self._messages:
            if topic in topics and start_ns <= received_ns < stop_ns:
                yield RawMessage(topic, received_ns, message)

    def _decoded(self, raw: Any, msgtype: str) -> Any:
        return raw() if callable(raw) else raw


def open_bag(bag: str | Path | Bag) -> Bag:
    """Return the bag at a path, to be entered as a context, or the given bag."""
    return bag if isinstance(bag, Bag) else Bag(bag)


def _bag_files(folder: Path) -> dict[str, Path]:
    """Return the bag files of a folder by their name without compression, ``…_10`` after ``…_9``; a
    plain file rather than its compressed copy."""
    compressed_first = sorted(folder.iterdir(), key=lambda path: path.suffix not in COMPRESSED)
    found = {_plain(path.name): path for path in compressed_first if _is_bag_file(path)}
    texts = {name: re.split(r"(\d+)", name) for name in found}
    keys = {name: [int(t) if t.isdecimal() else t for t in text] for name, text in texts.items()}
    return {name: found[name] for name in sorted(found, key=keys.__getitem__)}


def _plain(name: str) -> str:
    return name.removesuffix(".zstd").removesuffix(".zst")


def _is_bag_file(path: Path) -> bool:
    return path.is_file() and Path(_plain(path.name)).suffix in FORMATS
