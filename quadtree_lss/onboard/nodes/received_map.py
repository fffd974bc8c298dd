# SPDX-License-Identifier: Apache-2.0
"""The newest usable map that ``lss_node`` received, its age, and rejected maps."""

from __future__ import annotations

import time
from collections.abc import Callable

from nav_msgs.msg import OccupancyGrid

from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.outputs import map_from_messages
from quadtree_lss.onboard.messages.poses import check_frame
from quadtree_lss.onboard.nodes.diagnostics import Arrivals, Problems
from quadtree_lss.onboard.nodes.ros_messages import cloud_message, deserialised

STAMP = slice(4, 12)
"""Bytes of the stamp in a serialised message that begins with a header."""

MAX_MAP_AGE_S = 30.0
"""Age of the newest usable map after which sites are withdrawn; a killed mapping_node restarts much
faster."""


class ReceivedMap:
    """Join the two serialised messages of a map, and decode the newest complete map on demand.

    An unusable map is rejected: the last usable one is kept, and its age increases. With
    ``binding``, maps whose frame is not ``frame`` are rejected, and always maps that are too large
    for an assessment with the parameters that ``lss`` returns.

    Attributes:
        cells: The newest usable map; None before the first. ``frame`` is its frame.
        refused: Reason why the newest map was rejected; empty if it was used.
        refusals: Number of rejected maps.
    """

    def __init__(
        self, problems: Problems, frame: str, lss: Callable[[], LssConfig], *, binding: bool
    ) -> None:
        self.cells: CellMap | None = None
        self.frame = self._configured = frame
        self.arrivals = Arrivals()
        self.refused = ""
        self.refusals = 0
        self._problems = problems
        self._lss = lss
        self._binding = binding
        self._halves: dict[str, bytes] = {}
        self._complete: tuple[bytes, bytes, float] | None = None
        self._rejected: tuple[bytes, bytes, float] | None = None

    @property
    def lacks_observed(self) -> bool:
        """Whether cells wait for ``map/observed``, or no map has come yet."""
        return self.cells is None or "cells" in self._halves

    def add_half(self, half: str, raw: bytes) -> bool:
        """Add a message, ``cells`` or ``observed``; return True if both have the same stamp.

        Each message is used once, because the next map may have the same stamp. Only the newest
        complete map is kept: maps are skipped, not queued.
        """
        self._halves[half] = raw
        cells, observed = self._halves.get("cells"), self._halves.get("observed")
        if cells is None or observed is None or cells[STAMP] != observed[STAMP]:
            return False
        self._halves = {}
        self._complete = (cells, observed, time.monotonic())
        return True

    def missing(self) -> str:
        """Describe which messages of the first map are missing; empty once there is a map."""
        if self.cells is not None:
            return ""
        came = " and ".join(f"map/{half}" for half in sorted(self._halves))
        rest = "both halves" if len(self._halves) == 2 else "the other half"
        received = f"{came} came, {rest} of one stamp did not" if came else "nothing came"
        return f"a map: {self.refused or received}"

    def retry(self) -> None:
        """Let `decode_newest` decode a rejected map again, after a change of parameters."""
        self._complete = self._complete or self._rejected

    def decode_newest(self) -> None:
        """Decode the newest complete map if it is not decoded yet."""
        if self._complete is None:
            return
        newest, self._complete, self._rejected = self._complete, None, None
        raw_cells, raw_observed, arrival = newest
        try:
            cells, observed = cloud_message(raw_cells), deserialised(raw_observed, OccupancyGrid)
            frame = cells.header.frame_id
            if self._binding:
                check_frame(frame, self._configured, "map/cells")
            self.cells = map_from_messages(cells, observed, self._lss())
        except MessageError as error:
            self._rejected = newest
            self.refusals += 1
            self.refused = f"the newest map cannot be used: {error}"
            self._problems.report(f"map.{error.reason}", f"map not used: {error}")
        else:
            self.refused = ""
            self.frame = frame
            self.arrivals.add(arrival)

    def withdrawal_reason(self) -> str:
        """Return why sites on an old map have to be withdrawn; empty if they do not."""
        if self.cells is None or self.arrivals.age() <= MAX_MAP_AGE_S:
            return ""
        self.decode_newest()  # a map that is not decoded yet may be usable
        if self.arrivals.age() <= MAX_MAP_AGE_S:
            return ""
        text = f"no usable map came for {MAX_MAP_AGE_S:g} s"
        return f"{text}; {self.refused}" if self.refused else text
