# SPDX-License-Identifier: Apache-2.0
"""Messages that never were in a file, replayed like a bag."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

from quadtree_lss.desk.replay.bags import Bag, Topic
from quadtree_lss.desk.replay.records import RawMessage


class MessageBag(Bag):
    """A bag of messages as they come, once.

    Args:
        name: Stands for the path in summaries and messages.
        topics: All of them, with their numbers of messages.
        span_ns: Times of reception of the first and of the last message.
        messages: (topic, time of reception, message) in the order of reception.
    """

    def __init__(
        self,
        name: str,
        topics: Iterable[Topic],
        span_ns: tuple[int, int],
        messages: Iterable[tuple[str, int, Any]],
    ) -> None:
        super().__init__(Path(name))
        self._topics, self._span_ns, self._messages = list(topics), span_ns, messages

    def _open(self) -> None:
        return

    @property
    def topics(self) -> list[Topic]:
        """As of `Bag`."""
        return self._topics

    @property
    def start_ns(self) -> int:
        """As of `Bag`."""
        return self._span_ns[0]

    @property
    def end_ns(self) -> int:
        """As of `Bag`."""
        return self._span_ns[1]

    def messages(
        self, topics: Collection[str], start_ns: int = 0, stop_ns: int = 2**63 - 1
    ) -> Iterator[RawMessage]:
        """As of `Bag`; what stands for the bytes is the message itself."""
        for topic, received_ns, message in self._messages:
            if topic in topics and start_ns <= received_ns < stop_ns:
                yield RawMessage(topic, received_ns, message)

    def decode(self, raw: Any, msgtype: str) -> Any:
        """As of `Bag`."""
        return raw
