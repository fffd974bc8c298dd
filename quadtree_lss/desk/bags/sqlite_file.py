# SPDX-License-Identifier: Apache-2.0
"""Reader of rosbag2's sqlite3 files."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import suppress

from quadtree_lss.desk.bags.compression import MAX_BYTES, DamagedError
from quadtree_lss.desk.bags.recorded_file import RecordedFile, Row

ROWS = "SELECT timestamp, topic_id, id, 0 FROM messages"


class SqliteFile(RecordedFile):
    """An sqlite3 file. Only plain tables are read, because a view can take forever."""

    unit = "row"

    def _rows(self) -> Iterator[Row]:
        log = self.path.with_name(f"{self.path.name}-wal")  # left by a killed recorder
        logged, writable = log.exists() and log.stat().st_size, os.access(log.parent, os.W_OK)
        if logged and not writable:  # sqlite writes an index of the log beside it
            self.fault = f"{log.name} is not read because its folder is not writable"
        immutable = "" if logged and writable else "&immutable=1"
        uri = f"{self.path.resolve().as_uri()}?mode=ro{immutable}"
        self._database = sqlite3.connect(uri, uri=True)
        self._database.text_factory = lambda text: text.decode("utf-8", "replace")
        try:
            # Without this sqlite refuses a file that is shorter than its header declares.
            self._database.execute("PRAGMA writable_schema = ON")
            query = "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND rootpage > 0"
            tables = self._database.execute(f"{query} AND name IN ('topics', 'messages')")
            if tables.fetchone() != (2,):
                raise sqlite3.DatabaseError("topics and messages are not plain tables")
            for number, *topic in self._database.execute("SELECT id, name, type FROM topics"):
                self.topics[number] = (str(topic[0]), str(topic[1]))
            for time, channel, row, _ in self._sound_rows():
                yield time if isinstance(time, int) else -1, channel, row, 0
                if channel not in self.topics:
                    self._damage[row] = "no topic"
        except sqlite3.Error as error:
            self.fault = str(error)

    def _sound_rows(self) -> Iterator[Row]:
        """Yield the rows of the table up to the first damage, and then those that only the index of
        times still lists. A listed row that is not found is lost."""
        found: set[int] = set()
        damage = ""
        try:
            for row in self._database.execute(f"{ROWS} ORDER BY id"):
                found.add(row[2])
                yield row
        except sqlite3.Error as error:
            damage = str(error)
        try:
            listed = self._database.execute("SELECT id FROM messages INDEXED BY timestamp_idx")
            missing = sorted({number for (number,) in listed} - found)
        except sqlite3.Error:
            if damage:
                raise
            return  # a sound table without that index
        for number in missing:
            with suppress(sqlite3.Error):
                row = self._database.execute(f"{ROWS} WHERE id = ?", (number,)).fetchone()
                if row is not None:
                    yield row
                    continue
            self._damage[number] = damage or "not in the table of messages"
            self._unread.add((number, 0))

    def _load(self, position: int) -> Iterator[tuple[Row, bytes]]:
        query = "SELECT topic_id, data FROM messages WHERE id = ? AND typeof(data) = 'blob'"
        query += f" AND length(data) <= {MAX_BYTES}"
        try:
            row = self._database.execute(query, (position,)).fetchone()
        except sqlite3.Error as error:
            raise DamagedError(str(error)) from None
        if row is None:
            raise DamagedError("no data")
        yield (0, row[0], position, 0), row[1]

    def close(self) -> None:
        self._database.close()
        super().close()
