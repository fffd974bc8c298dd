# SPDX-License-Identifier: Apache-2.0
"""Reading rosbag2's sqlite3 files in whatever state, without running what may stand in them.

Only true tables are asked: a view or a computed column could take for ever. A row costs no more
than itself; where a query ends in damage, the rest is asked for row by row.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np

from quadtree_lss.desk.replay.records import Extent, RawMessage, mended, stamp_of, steps_back
from quadtree_lss.desk.replay.unpack import MOST_BYTES

MISSES_IN_A_ROW = 10_000
"""So many numbers without a row end the search for more."""
_STEPS = 100_000
"""Of sqlite's machine between two looks at how much it has done."""


class SqliteFile:
    """A rosbag2 sqlite3 file.

    Attributes:
        path: The file.
        notes: What to know, one line each.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []
        self._faults: dict[str, int] = {}
        self._topics: dict[int, tuple[str, str]] = {}
        # A sound table is read in a few steps for each of its bytes.
        self._left = 100 + 10 * path.stat().st_size // _STEPS
        self._rows = np.zeros((0, 3), dtype=np.int64)
        self._unread: dict[int, str] = {}
        database = self._connect()
        try:
            self._read_topics(database)
            self._rows = np.fromiter(self._index(database), dtype=np.dtype((np.int64, 3)))
            self._put_in_order(database)
        except sqlite3.Error as error:
            self._fault(str(error))
        finally:
            database.close()

    @property
    def losses(self) -> list[str]:
        """One line for each kind of what could not be read, up to now."""
        faults = [
            f"{number} x {what}" if number > 1 else what for what, number in self._faults.items()
        ]
        if self._unread:
            row, why = next(iter(self._unread.items()))
            faults.append(f"{len(self._unread)} messages lost, the first in row {row}: {why}")
        return [f"{self.path.name}: {fault}" for fault in faults]

    def extent(self) -> Extent:
        """Topics, numbers of messages and times."""
        counts = Counter(self._topics[int(channel)][0] for channel in self._rows[:, 1])
        times = self._rows[:, 2]
        start, end = (int(times.min()), int(times.max())) if len(times) else (0, 0)
        return Extent(dict(self._topics.values()), dict(counts), start, end)

    def messages(
        self, topics: Collection[str] | None, start_ns: int, stop_ns: int
    ) -> Iterator[RawMessage]:
        """Messages with start_ns <= time of reception < stop_ns; None for all topics.

        In the order of their times or, if a clock stepped back, in that of the rows.
        """
        wanted = [c for c, (name, _) in self._topics.items() if topics is None or name in topics]
        rows = self._rows[np.isin(self._rows[:, 1], wanted)]
        rows = rows[(rows[:, 2] >= start_ns) & (rows[:, 2] < stop_ns)]
        database = self._connect()
        try:
            for row, channel, time_ns in rows.tolist():
                raw = self._data(database, row)
                if raw is not None:
                    yield RawMessage(self._topics[channel][0], time_ns, raw)
        finally:
            database.close()

    def _fault(self, what: str) -> None:
        self._faults[what] = self._faults.get(what, 0) + 1

    def _connect(self) -> sqlite3.Connection:
        uri = f"{self.path.resolve().as_uri()}?mode=ro&immutable=1"
        database = sqlite3.connect(uri, uri=True)
        database.text_factory = lambda text: text.decode("utf-8", "replace")
        # Otherwise a file shorter than its header says is refused as a whole.
        database.execute("PRAGMA writable_schema = ON")
        database.set_progress_handler(self._worked, _STEPS)
        return database

    def _worked(self) -> int:
        """Ends a query that does far more than read what is there; 0 lets it go on."""
        self._left -= 1
        return int(self._left < 0)

    def _read_topics(self, database: sqlite3.Connection) -> None:
        for table in ("topics", "messages"):
            query = "SELECT type, rootpage FROM sqlite_master WHERE name = ?"
            kind, page = database.execute(query, (table,)).fetchone() or ("missing", 0)
            columns = database.execute(f"PRAGMA table_xinfo({table})").fetchall()
            if kind != "table" or not page or any(column[-1] for column in columns):
                msg = f"{table} is not a plain table ({kind})"
                raise sqlite3.DatabaseError(msg)
        rows = database.execute("SELECT id, name, type FROM topics").fetchmany(1 << 16)
        for number, name, kind in rows:
            if isinstance(number, int) and isinstance(name, str) and isinstance(kind, str):
                self._topics[number] = (name, kind)
            else:
                self._fault("topic that cannot be read")

    def _index(self, database: sqlite3.Connection) -> Iterator[tuple[int, int, int]]:
        """Number, topic and time of each usable row, in their order."""
        last = 0
        try:
            query = "SELECT id, topic_id, timestamp FROM messages ORDER BY id"
            for row in database.execute(query):
                last = max(last, row[0] if isinstance(row[0], int) else 0)
                yield from self._usable(*row)
        except sqlite3.Error as error:
            self._fault(f"rows that cannot be read: {error}")
            yield from self._one_by_one(database, last)

    def _one_by_one(self, database: sqlite3.Connection, row: int) -> Iterator[tuple[int, int, int]]:
        missing = 0
        while missing < MISSES_IN_A_ROW and self._left > 0:
            row, missing = row + 1, missing + 1
            query = "SELECT id, topic_id, timestamp FROM messages WHERE id = ?"
            try:
                found = database.execute(query, (row,)).fetchone()
            except sqlite3.Error as error:
                self._unread[row] = str(error)
                continue
            if found is not None:
                missing = 0
                yield from self._usable(*found)

    def _usable(self, row: object, channel: object, time: object) -> Iterator[tuple[int, int, int]]:
        if not isinstance(row, int) or channel not in self._topics:
            self._fault("row of no topic")
        else:
            assert isinstance(channel, int)
            sound = isinstance(time, int) and time >= 0
            yield row, channel, time if sound and isinstance(time, int) else -1

    def _put_in_order(self, database: sqlite3.Connection) -> None:
        rows = self._rows
        bad = rows[:, 2] < 0
        for k in np.flatnonzero(bad):  # as of the row before
            rows[k, 2] = rows[k - 1, 2] if k else rows[np.argmin(bad), 2]
        rows[:, 2], more = mended(np.maximum(rows[:, 2], 0))
        if bad.any() or more:
            number = int(np.count_nonzero(bad)) + more
            self._faults[
                "row with an impossible time of reception, taken as of its neighbour's"
            ] = number
        by_time = rows[np.argsort(rows[:, 2], kind="stable")]
        series = [rows[rows[:, 1] == channel, 2] for channel in self._topics]
        if any(map(steps_back, series)) and self._stamps_back(database, by_time) > (
            self._stamps_back(database, rows)
        ):
            self.notes.append(f"{self.path.name}: the recorder's clock stepped back")
        else:
            self._rows = by_time

    def _stamps_back(self, database: sqlite3.Connection, rows: np.ndarray) -> int:
        """How often the stamps of some topic's messages go back in an order of the rows."""
        stamps: dict[int, list[int]] = {channel: [] for channel in self._topics}
        for row, channel, _ in rows.tolist():
            raw = self._data(database, row)
            stamp = None if raw is None else stamp_of(raw, self._topics[channel][1], ros1=False)
            if stamp is not None:
                stamps[channel].append(stamp)
        return sum(map(steps_back, stamps.values()))

    def _data(self, database: sqlite3.Connection, row: int) -> bytes | None:
        """Serialised bytes in a row; None if they cannot be read."""
        query = "SELECT length(data), typeof(data) FROM messages WHERE id = ?"
        try:
            length, kind = database.execute(query, (row,)).fetchone()
            if kind == "blob" and length <= MOST_BYTES:
                query = "SELECT data FROM messages WHERE id = ?"
                found: bytes = database.execute(query, (row,)).fetchone()[0]
                return found
            self._unread[row] = f"data are {kind} of {length} bytes"
        except (sqlite3.Error, TypeError) as error:
            self._unread[row] = str(error)
        return None
