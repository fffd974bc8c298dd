# SPDX-License-Identifier: Apache-2.0
"""The files of a bag, each of one of three formats."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Protocol

from quadtree_lss.desk.replay.mcap_file import McapFile
from quadtree_lss.desk.replay.records import Extent, RawMessage
from quadtree_lss.desk.replay.ros1_file import Ros1File
from quadtree_lss.desk.replay.sqlite_file import SqliteFile


class _File(Protocol):
    """A file in whatever state."""

    notes: list[str]

    @property
    def losses(self) -> list[str]: ...

    def extent(self) -> Extent: ...

    def messages(
        self, topics: Collection[str] | None, start_ns: int, stop_ns: int
    ) -> Iterator[RawMessage]: ...


class Part:
    """One file of a bag.

    Attributes:
        path: The file.
        ros1: It is a ROS 1 bag.
        extent: What is in it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.ros1 = path.suffix == ".bag"
        path.open("rb").close()  # one that may not be read is no damaged one
        kinds: dict[str, type[_File]] = {".mcap": McapFile, ".db3": SqliteFile, ".bag": Ros1File}
        self._file: _File = kinds[path.suffix](path)  # type: ignore[call-arg]
        self.extent = self._file.extent()

    @property
    def losses(self) -> list[str]:
        """What could not be read up to now."""
        return self._file.losses

    @property
    def notes(self) -> list[str]:
        """What to know of it."""
        return self._file.notes

    def messages(
        self, topics: Collection[str], start_ns: int, stop_ns: int
    ) -> Iterator[RawMessage]:
        """Messages of the topics with start_ns <= time of reception < stop_ns, in order."""
        return self._file.messages(topics, start_ns, stop_ns)


def of_one_time(parts: Iterable[Part]) -> list[list[Part]]:
    """Files in their order, grouped with those before them whose time and no topic they share.

    Files of the same topics are parts of one recording, whose clock may have stepped back.
    """
    groups: list[list[Part]] = []
    for part in parts:
        if groups and any(_beside(part.extent, other.extent) for other in groups[-1]):
            groups[-1].append(part)
        else:
            groups.append([part])
    return groups


def _beside(one: Extent, other: Extent) -> bool:
    if one.counts.keys() & other.counts.keys():
        return False
    return one.start_ns < other.end_ns and other.start_ns < one.end_ns
