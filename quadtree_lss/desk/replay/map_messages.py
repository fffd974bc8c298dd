# SPDX-License-Identifier: Apache-2.0
"""Maps in bags: the two topics of a map found, and joined by their stamps."""

from __future__ import annotations

from typing import Any

from quadtree_lss.desk.replay.bags import Bag
from quadtree_lss.desk.replay.records import RawMessage
from quadtree_lss.desk.replay.types import SCAN_TYPE
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.messages.clouds import MessageError, stamp_ns
from quadtree_lss.onboard.messages.maps import MapMessageError
from quadtree_lss.onboard.messages.outputs import (
    CELLS,
    GRID_TYPE,
    OBSERVED,
    SITE_TABLE,
    STATUS,
    map_from_messages,
)


class MapPairs:
    """Joins ``map/cells`` and ``map/observed`` of one stamp to maps, in any namespace."""

    def __init__(self, cells_topic: str, observed_topic: str) -> None:
        self.topics = (cells_topic, observed_topic)
        self._held: dict[str, Any] = {}

    @classmethod
    def find(cls, bag: Bag) -> MapPairs | None:
        """The map topics of an open bag, None if it has none."""
        names = {topic.name: topic.type for topic in bag.topics if topic.count}
        for name, kind in names.items():
            observed = name.removesuffix(CELLS) + OBSERVED
            if name.endswith(f"/{CELLS}") and kind == SCAN_TYPE and observed in names:
                return cls(name, observed)
        return None

    @classmethod
    def alone(cls, bag: Bag) -> MapPairs | None:
        """The map topics of an open bag that has no scans, None if it has."""
        pairs = cls.find(bag)
        if pairs is None:
            return None
        clouds = {topic.name for topic in bag.topics if topic.type == SCAN_TYPE and topic.count}
        ours = {pairs.topics[0].removesuffix(CELLS) + name for name in (CELLS, SITE_TABLE, STATUS)}
        return None if clouds - ours else pairs

    def take(self, bag: Bag, message: RawMessage, lss: LssConfig | None = None) -> CellMap | None:
        """The map that this message completes, None if its other half is still missing.

        Args:
            bag, message: An open bag and one of its messages on ``topics``.
            lss: How landing will be judged on the map, None if it will not.

        Raises:
            MapMessageError: a message is not what ``mapping_node`` sends.
        """
        kind = SCAN_TYPE if message.topic == self.topics[0] else GRID_TYPE
        try:
            self._held[message.topic] = bag.decode(message.raw, kind)
            cells, observed = (self._held.get(topic) for topic in self.topics)
            if cells is None or observed is None:
                return None
            if stamp_ns(cells.header) != stamp_ns(observed.header):
                return None
        except MessageError as error:
            raise MapMessageError(error.reason, str(error)) from None
        self._held.clear()
        return map_from_messages(cells, observed, lss)
