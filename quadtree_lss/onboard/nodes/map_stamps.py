# SPDX-License-Identifier: Apache-2.0
"""Stamps of maps as they are published."""

from __future__ import annotations


class MapStamps:
    """No two maps in a row have the same stamp: the two messages of a map are matched by it.

    After a late scan or the loading of a file a map may differ from the last one while its newest
    scan is the same: it is a nanosecond later then. Only the empty map has stamp 0.

    Attributes:
        content_changed: Set it whenever the map is another than the one published last.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """The map is empty."""
        self.content_changed = False
        self._newest_ns = self._last_ns = 0

    def next(self, newest_ns: int) -> int:
        """Stamp of the next publication of a map whose newest scan has this stamp."""
        stamp_ns = self._last_ns if newest_ns == self._newest_ns else newest_ns
        if self.content_changed and stamp_ns == self._last_ns:
            stamp_ns += 1
        self.content_changed = False
        self._newest_ns, self._last_ns = newest_ns, stamp_ns
        return stamp_ns
