# SPDX-License-Identifier: Apache-2.0
"""The files of a bag, each read by ``rosbags`` or, where that fails, by `rescue`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Protocol

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader

from quadtree_lss.replay.rescue import Extent, RawMessage, RescuedMcap
from quadtree_lss.replay.rescue_ros1 import RescuedRos1
from quadtree_lss.replay.rescue_sqlite import RescuedSqlite


class _Rescue(Protocol):
    """A reader for files that rosbags cannot read, or not to their end."""

    losses: list[str]

    def extent(self) -> Extent: ...

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]: ...


class Part:
    """One file of a bag: healthy by rosbags' reader, otherwise rescued."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        self.path = path
        self.ros1 = path.suffix == ".bag"
        self._reader: Any = None
        self._rescue: _Rescue | None = None
        try:
            reader = Ros1Reader(path) if self.ros1 else Ros2Reader(path)
            self._reader = stack.enter_context(reader)
            self.extent = _extent(reader)
        except PermissionError:
            raise
        except Exception:  # rosbags raises nearly anything on damaged files
            self._reader = None
            self._rescue = self._rescuer()
            self.extent = self._rescue.extent()

    @property
    def losses(self) -> list[str]:
        """What could not be read up to now."""
        return self._rescue.losses if self._rescue is not None else []

    def messages(
        self, topics: Collection[str], start_ns: int, stop_ns: int
    ) -> Iterator[RawMessage]:
        """Messages of the topics with start_ns <= time of reception < stop_ns, in order."""
        last, at_last = start_ns, Counter[str]()
        if self._reader is not None:
            wanted = [c for c in self._reader.connections if c.topic in topics]
            if not wanted:
                return
            try:
                for connection, received, raw in self._reader.messages(wanted, start_ns, stop_ns):
                    if received != last:
                        last, at_last = received, Counter()
                    at_last[connection.topic] += 1
                    yield RawMessage(connection.topic, received, raw)
                return
            except Exception:  # as above
                self._rescue = self._rescuer()
        assert self._rescue is not None
        for message in self._rescue.messages(topics):
            if not last <= message.received_ns < stop_ns:
                continue
            if message.received_ns == last and at_last[message.topic] > 0:
                at_last[message.topic] -= 1  # came before the damage
                continue
            yield message

    def _rescuer(self) -> _Rescue:
        kinds: dict[str, Callable[[Path], _Rescue]] = {
            ".mcap": RescuedMcap,
            ".db3": RescuedSqlite,
            ".bag": RescuedRos1,
        }
        return kinds[self.path.suffix](self.path)


def _extent(reader: Any) -> Extent:
    types = {c.topic: c.msgtype for c in reader.connections}
    counts: dict[str, int] = {}
    for connection in reader.connections:
        counts[connection.topic] = counts.get(connection.topic, 0) + _count(connection)
    # rosbags' end is one beyond the last message
    return Extent(types, counts, reader.start_time, reader.end_time - 1)


def of_one_time(parts: Iterable[Part]) -> list[list[Part]]:
    """Files in their order, grouped with those before them whose time they share."""
    groups: list[list[Part]] = []
    for part in parts:
        if groups and any(_overlap(part.extent, other.extent) for other in groups[-1]):
            groups[-1].append(part)
        else:
            groups.append([part])
    return groups


def _overlap(one: Extent, other: Extent) -> bool:
    return one.start_ns < other.end_ns and other.start_ns < one.end_ns


def _count(connection: Connection) -> int:
    return int(connection.msgcount)
