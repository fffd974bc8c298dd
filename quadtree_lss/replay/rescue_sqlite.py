# SPDX-License-Identifier: Apache-2.0
"""What can still be read of a damaged rosbag2 sqlite3 file: it is asked row by row."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator
from pathlib import Path

from quadtree_lss.replay.rescue import Extent, RawMessage, count_messages


class RescuedSqlite:
    """A rosbag2 sqlite3 file without the rows that cannot be read, which ``losses`` reports."""

    MISSES_IN_A_ROW = 10_000

    def __init__(self, path: Path) -> None:
        self.path = path
        self.losses: list[str] = []

    def extent(self) -> Extent:
        """Topics, numbers of messages and times, by reading the whole file once."""
        types = {name: kind for name, kind in self._topics().values()}
        return Extent(types, *count_messages(self.messages()))

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Readable messages in the order in which they were written; None for all topics."""
        self.losses = []
        names = self._topics()
        database = self._open()
        try:
            row, missing, failed, error = 0, 0, 0, ""
            while missing < self.MISSES_IN_A_ROW:
                row += 1
                query = "SELECT topic_id, timestamp, data FROM messages WHERE id = ?"
                try:
                    found = database.execute(query, (row,)).fetchone()
                except sqlite3.Error as problem:
                    found, failed, error = None, failed + 1, str(problem)
                if found is None:
                    missing += 1
                    continue
                missing = 0
                if not (isinstance(found[1], int) and isinstance(found[2], bytes)):
                    failed, error = failed + 1, "values of another type"
                    continue
                name, _ = names.get(found[0], ("", ""))
                if name and (topics is None or name in topics):
                    yield RawMessage(name, found[1], found[2])
            if failed:
                self.losses.append(f"{self.path.name}: rows that cannot be read: {error}")
        finally:
            database.close()

    def _open(self) -> sqlite3.Connection:
        uri = f"{self.path.resolve().as_uri()}?mode=ro&immutable=1"
        database = sqlite3.connect(uri, uri=True)
        # Otherwise a file shorter than its header says is refused as a whole.
        database.execute("PRAGMA writable_schema = ON")
        return database

    def _topics(self) -> dict[int, tuple[str, str]]:
        database = self._open()
        try:
            rows = database.execute("SELECT id, name, type FROM topics").fetchall()
        except sqlite3.Error as error:
            self.losses.append(f"{self.path.name}: {error}")
            return {}
        finally:
            database.close()
        return {number: (name, kind) for number, name, kind in rows}
