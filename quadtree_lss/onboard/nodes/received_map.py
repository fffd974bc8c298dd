# SPDX-License-Identifier: Apache-2.0
"""The map as ``lss_node`` has it: the newest it could use, its age, and what was refused."""

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
"""Of a serialised message that begins with a header."""

MAX_MAP_AGE_S = 30.0
"""Sites are withdrawn when no map that can be used has come for longer: a killed mapping_node is
back well before, and nobody should fly on for half a minute by what is looked at no more."""


class ReceivedMap:
    """Joins the two messages of a map, serialised, and decodes them when asked to.

    A map that cannot be used has not been received: the one before (``cells``, None before the
    first, in its ``frame``) is kept, and its age runs on; ``refused`` says why, empty if the newest
    was used. ``lss`` is how landing is judged at present: maps too large for that are refused, and,
    if ``binding``, maps of another frame than the configuration's.
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
        self._whole: tuple[bytes, bytes, float] | None = None
        self._kept: tuple[bytes, bytes, float] | None = None  # refused

    @property
    def lacks_observed(self) -> bool:
        """True while cells wait for ``map/observed``, and before the first map."""
        return self.cells is None or "cells" in self._halves

    def add_half(self, half: str, raw: bytes) -> bool:
        """Takes one of a map's two messages, ``cells`` or ``observed``: it is complete when both
        carry the same stamp.

        Neither is used twice: the next map may have the same stamp, and its cells must not be
        joined with what was observed before. Only the newest map is kept and decoded when its
        turn comes: maps are skipped, not queued.
        """
        self._halves[half] = raw
        cells, observed = self._halves.get("cells"), self._halves.get("observed")
        if cells is None or observed is None or cells[STAMP] != observed[STAMP]:
            return False
        self._halves = {}
        self._whole = (cells, observed, time.monotonic())
        return True

    def missing(self) -> str:
        """What is not there yet of a first map, empty once there is one."""
        if self.cells is not None:
            return ""
        came = " and ".join(f"map/{half}" for half in sorted(self._halves))
        rest = "both halves" if len(self._halves) == 2 else "the other half"
        heard = f"{came} came, {rest} of one stamp did not" if came else "nothing came"
        return f"a map: {self.refused or heard}"

    def retry(self) -> None:
        """Landing is judged otherwise now: the next `take` decodes a map that was refused again."""
        self._whole = self._whole or self._kept

    def decode_newest(self) -> None:
        """Decodes the newest complete map if that was not done yet."""
        if self._whole is None:
            return
        whole, self._whole, self._kept = self._whole, None, None
        raw_cells, raw_observed, arrival = whole
        try:
            cells, observed = cloud_message(raw_cells), deserialised(raw_observed, OccupancyGrid)
            frame = cells.header.frame_id
            if self._binding:
                check_frame(frame, self._configured, "map/cells")
            self.cells = map_from_messages(cells, observed, self._lss())
        except MessageError as error:
            self._kept = whole
            self.refusals += 1
            self.refused = f"the newest map cannot be used: {error}"
            self._problems.report(f"map.{error.reason}", f"map not used: {error}")
        else:
            self.refused = ""
            self.frame = frame
            self.arrivals.add(arrival)

    def withdrawal_reason(self) -> str:
        """Why sites on the map are to be withdrawn, empty if they are not."""
        if self.cells is None or self.arrivals.age() <= MAX_MAP_AGE_S:
            return ""
        self.decode_newest()  # one that waits for its turn counts if it can be used
        if self.arrivals.age() <= MAX_MAP_AGE_S:
            return ""
        text = f"no map that could be used came for {MAX_MAP_AGE_S:g} s"
        return f"{text}; {self.refused}" if self.refused else text
