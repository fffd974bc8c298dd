# SPDX-License-Identifier: Apache-2.0
"""The nodes' output topics as messages of bags: written without ROS, and maps read back."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys.store import Typestore

from quadtree_lss.core.quadtree import CellMap
from quadtree_lss.core.sites import LandingAssessment
from quadtree_lss.messages.clouds import MessageError, stamp_ns
from quadtree_lss.messages.maps import (
    CELL_FIELDS,
    POINT_FIELD_TYPES,
    SITE_FIELDS,
    MapMessageError,
    decode_cells,
    encode_cells,
    encode_hazards,
    encode_observed,
    encode_score,
    encode_sites,
    record_dtype,
    site_orientations,
)
from quadtree_lss.replay.bags import Bag
from quadtree_lss.replay.rescue import RawMessage
from quadtree_lss.replay.types import GRID_TYPE, POSES_TYPE, SCAN_TYPE

CELLS, OBSERVED = "map/cells", "map/observed"
SITES, SITE_TABLE = "landing/sites", "landing/site_table"
HAZARDS, SCORE = "landing/hazards", "landing/score"
TOPIC_TYPES = {
    CELLS: SCAN_TYPE,
    OBSERVED: GRID_TYPE,
    SITES: POSES_TYPE,
    SITE_TABLE: SCAN_TYPE,
    HAZARDS: GRID_TYPE,
    SCORE: GRID_TYPE,
}
"""Relative names of the outputs and their types."""

Fields = tuple[tuple[str, str], ...]
Named = tuple[str, Any]


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

    def take(self, bag: Bag, message: RawMessage) -> CellMap | None:
        """The map that this message completes, None if its other half is still missing.

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
        return _map(cells, observed)


def _map(cloud: Any, grid: Any) -> CellMap:
    values = np.asarray(grid.data, dtype=np.int8)
    if values.size != grid.info.height * grid.info.width:
        msg = f"map/observed of {grid.info.width} x {grid.info.height} has {values.size} values"
        raise MapMessageError("observed_size", msg)
    observed = values.reshape(grid.info.height, grid.info.width) > 0
    at = grid.info.origin.position
    return decode_cells(_records(cloud), observed, at.x, at.y, stamp_ns(cloud.header))


def _records(cloud: Any) -> NDArray[np.void]:
    kinds = record_dtype(CELL_FIELDS)
    found = [(item.name, item.offset, item.datatype) for item in cloud.fields]
    count = cloud.width * cloud.height
    fits = found == _layout(CELL_FIELDS) and not cloud.is_bigendian
    if not fits or len(cloud.data) != count * kinds.itemsize or cloud.point_step != kinds.itemsize:
        msg = f"map/cells ({len(found)} fields, {cloud.point_step} bytes) is not as in msg_docs"
        raise MapMessageError("layout", msg)
    return np.frombuffer(bytes(cloud.data), dtype=kinds)


def _layout(fields: Fields) -> list[tuple[str, int, int]]:
    kinds = record_dtype(fields)
    offsets: Mapping[str, Any] = kinds.fields or {}
    return [(name, offsets[name][1], POINT_FIELD_TYPES[kind]) for name, kind in fields]


class MessageMaker:
    """Builds the output messages with the types of a store."""

    def __init__(self, store: Typestore, frame: str) -> None:
        self._types, self._frame = store.types, frame

    def of_map(self, cells: CellMap) -> Iterator[Named]:
        """``map/cells`` and ``map/observed``."""
        domain, stamp = cells.domain, cells.stamp_ns
        yield CELLS, self._cloud(encode_cells(cells), CELL_FIELDS, stamp)
        values = encode_observed(cells.observed)
        yield OBSERVED, self._grid(values, domain.xmin, domain.ymin, domain.finest_size, stamp)

    def of_landing(self, assessment: LandingAssessment) -> Iterator[Named]:
        """The four ``landing/`` topics."""
        stamp, x, y = assessment.stamp_ns, assessment.x, assessment.y
        spacing = float(x[1] - x[0]) if len(x) > 1 else 1.0
        west, south = float(x[0]) - 0.5 * spacing, float(y[0]) - 0.5 * spacing
        hazards, score = encode_hazards(assessment), encode_score(assessment)
        yield HAZARDS, self._grid(hazards, west, south, spacing, stamp)
        yield SCORE, self._grid(score, west, south, spacing, stamp)
        yield SITE_TABLE, self._cloud(encode_sites(assessment), SITE_FIELDS, stamp)
        yield SITES, self._poses(assessment)

    def _make(self, kind: str, /, **values: Any) -> Any:
        return self._types[kind](**values)

    def _time(self, stamp: int) -> Any:
        return self._make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)

    def _header(self, stamp: int) -> Any:
        return self._make("std_msgs/msg/Header", stamp=self._time(stamp), frame_id=self._frame)

    def _pose(self, position: Any, xyzw: Any) -> Any:
        x, y, z = map(float, position)
        a, b, c, d = map(float, xyzw)
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._make("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=self._make("geometry_msgs/msg/Quaternion", x=a, y=b, z=c, w=d),
        )

    def _cloud(self, records: NDArray[np.void], fields: Fields, stamp: int) -> Any:
        size = records.dtype.itemsize
        return self._make(
            SCAN_TYPE,
            header=self._header(stamp),
            height=1,
            width=len(records),
            fields=[
                self._make(
                    "sensor_msgs/msg/PointField", name=name, offset=at, datatype=kind, count=1
                )
                for name, at, kind in _layout(fields)
            ],
            is_bigendian=False,
            point_step=size,
            row_step=size * len(records),
            data=np.frombuffer(records.tobytes(), dtype=np.uint8),
            is_dense=False,
        )

    def _grid(
        self, values: NDArray[np.int8], west: float, south: float, side: float, stamp: int
    ) -> Any:
        info = self._make(
            "nav_msgs/msg/MapMetaData",
            map_load_time=self._time(stamp),
            resolution=float(side),
            width=values.shape[1],
            height=values.shape[0],
            origin=self._pose((west, south, 0.0), (0.0, 0.0, 0.0, 1.0)),
        )
        data = np.ascontiguousarray(values, dtype=np.int8).ravel()
        return self._make(GRID_TYPE, header=self._header(stamp), info=info, data=data)

    def _poses(self, assessment: LandingAssessment) -> Any:
        sites = assessment.sites
        turns = site_orientations(sites.normal)
        poses = [self._pose(p, q) for p, q in zip(sites.position, turns, strict=True)]
        return self._make(POSES_TYPE, header=self._header(assessment.stamp_ns), poses=poses)
