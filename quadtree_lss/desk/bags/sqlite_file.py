# SPDX-License-Identifier: Apache-2.0
"""Reading rosbag2's sqlite3 files in whatever state, without running what may stand in them.

Only true tables are asked: a view or a computed column could take for ever. A row costs no more
than itself; where a query ends in damage, the rest is asked for row by row.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.desk.bags.compression import MOST_BYTES
from quadtree_lss.desk.bags.recorded_file import INDEX, RecordedFile

MISSES_IN_A_ROW = 10_000
"""So many numbers of rows that cannot be read end the search for more."""
_STEPS = 100_000
"""Of sqlite's machine between two looks at how much it has done."""


class SqliteFile(RecordedFile):
    unit = "row"

    def _open(self) -> None:
        # A sound table is read in a few steps for each of its bytes.
        self._left = 100 + 10 * self._size // _STEPS
        log = self.path.with_name(f"{self.path.name}-wal")  # of a recorder that was killed
        logged, writable = log.exists() and log.stat().st_size, os.access(log.parent, os.W_OK)
        if logged and not writable:  # sqlite makes an index of the log beside it
            self.fault = f"{log.name} is not read, for its folder cannot be written"
        immutable = "" if logged and writable else "&immutable=1"
        uri = f"{self.path.resolve().as_uri()}?mode=ro{immutable}"
        self._database = sqlite3.connect(uri, uri=True)
        self._database.text_factory = lambda text: text.decode("utf-8", "replace")
        try:
            # Otherwise a file shorter than its header says is refused as a whole.
            self._database.execute("PRAGMA writable_schema = ON")
            self._database.set_progress_handler(self._worked, _STEPS)
            self._read_topics()
            self.index = np.fromiter(self._rows(), INDEX)
        except (sqlite3.Error, TypeError) as error:  # or rows without a number
            self.fault = str(error)

    def close(self) -> None:
        self._database.close()
        super().close()

    def _worked(self) -> int:
        """Ends a query that does far more than read what is there; 0 lets it go on."""
        self._left -= 1
        return int(self._left < 0)

    def _read_topics(self) -> None:
        for table in ("topics", "messages"):
            query = "SELECT type, rootpage FROM sqlite_master WHERE name = ?"
            kind, page = self._database.execute(query, (table,)).fetchone() or ("missing", 0)
            columns = self._database.execute(f"PRAGMA table_xinfo({table})").fetchall()
            if kind != "table" or not page or any(column[-1] for column in columns):
                raise sqlite3.DatabaseError(f"{table} is not a plain table ({kind})")
        rows = self._database.execute("SELECT id, name, type FROM topics").fetchmany(1 << 16)
        for number, name, kind in rows:
            if isinstance(number, int) and isinstance(name, str) and isinstance(kind, str):
                self.topics[number] = (name, kind)
            else:
                self.fault = "topic that cannot be read"

    def _rows(self) -> Iterator[tuple[int, int, int, int]]:
        """`INDEX` of each usable row, in their order; an impossible time is -1."""
        query = "SELECT id, topic_id, timestamp FROM messages WHERE id >= ? ORDER BY id LIMIT ?"
        last, missed, most = -(2**62), 0, -1
        while missed < MISSES_IN_A_ROW and self._left > 0:
            found = False
            try:
                for row, channel, time in self._database.execute(query, (last + missed + 1, most)):
                    if missed:
                        self.damage[last + 1], self.lost[last + 1] = "unreadable rows", missed
                    last, missed, found = max(last, row), 0, True
                    if isinstance(channel, int) and channel in self.topics:
                        yield time if isinstance(time, int) else -1, row, channel, 0
                    else:
                        self._lose(row, "no topic")
                if not found:
                    return
            except sqlite3.Error as error:
                self.fault = f"rows that cannot be read: {error}"
                last, missed, most = max(last, 0), missed + (most == 1), 1

    def _lose(self, row: int, why: str) -> None:
        self.damage[row], self.lost[row] = why, 1

    def _contents(self, places: NDArray[np.intp]) -> Iterator[tuple[int, bytes]]:
        size = "SELECT length(data), typeof(data) FROM messages WHERE id = ?"
        for place in map(int, places):
            row = int(self.index[place]["offset"])
            try:
                length, kind = self._database.execute(size, (row,)).fetchone()
                if kind == "blob" and length <= MOST_BYTES:
                    query = "SELECT data FROM messages WHERE id = ?"
                    yield place, self._database.execute(query, (row,)).fetchone()[0]
                else:
                    self._lose(row, f"data are {kind} of {length} bytes")
            except (sqlite3.Error, TypeError) as error:
                self._lose(row, str(error))
