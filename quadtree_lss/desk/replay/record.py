# SPDX-License-Identifier: Apache-2.0
"""Recording of the messages that the nodes would publish: maps and landing sites."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags import interfaces as ros
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from quadtree_lss.desk.bags.message_types import typestore
from quadtree_lss.desk.replay.files import ReplayError, writing
from quadtree_lss.onboard.core.landing.result import LandingAssessment
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.messages import outputs

GRID_MAP_INTERVAL_NS = 10**9
"""Least interval of ``landing/grid_map``, which is large, ns; the last one is always written."""
_NO_TIME = ros.QosTime(0, 0)
_LATCHED = (
    ros.QosHistory.KEEP_LAST,
    1,
    ros.QosReliability.RELIABLE,
    ros.QosDurability.TRANSIENT_LOCAL,
)
LATCHED = ros.Qos(*_LATCHED, _NO_TIME, _NO_TIME, ros.QosLiveliness.AUTOMATIC, _NO_TIME, False)
"""QoS profile of latched topics, which `ros2 bag play` then serves to late subscribers."""


class Recorder:
    """Context manager that writes outputs of `Assessments` into a new mcap bag, a folder ``path``.
    ``frame``: of the map. ``maps``: also write maps. Raises `ReplayError`: ``path`` exists or
    cannot be written."""

    def __init__(self, path: Path, frame: str, *, maps: bool = True) -> None:
        self._path, self._maps = path, maps
        if path.exists():
            raise ReplayError(f"--record {path}: cannot be written: it exists already")
        with writing(path, ReplayError):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._writer.open()
        self._store = typestore(ros1=False)
        self._messages = outputs.MessageMaker(self._store.types, np.asarray, frame)
        self._connections: dict[str, Any] = {}
        self._grid_map_ns: int | None = None  # time of the last landing/grid_map
        self._pending: tuple[int, LandingAssessment] | None = None

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pending is not None:
            self._write_grid_map(*self._pending)
        with writing(self._path, ReplayError):
            self._writer.close()
        if not self._connections:
            shutil.rmtree(self._path, ignore_errors=True)

    def map(self, now_ns: int, snapshot: Callable[[], CellMap]) -> None:
        if not self._maps:
            return
        for topic, message in self._messages.of_map(snapshot()):
            self._write(topic, message, now_ns)

    def landing(self, now_ns: int, found: LandingAssessment) -> None:
        age = 1e-9 * (now_ns - found.stamp_ns) if found.stamp_ns else float("nan")
        target = self._messages.of_target(found, age)
        for topic, message in (*target, *self._messages.of_ground(found)):
            self._write(topic, message, now_ns)
        self._pending = (now_ns, found)
        if self._grid_map_ns is None or abs(now_ns - self._grid_map_ns) >= GRID_MAP_INTERVAL_NS:
            self._write_grid_map(now_ns, found)

    def _write_grid_map(self, now_ns: int, found: LandingAssessment) -> None:
        self._grid_map_ns, self._pending = now_ns, None
        self._write(outputs.GRID_MAP, self._messages.grid_map(found), now_ns)

    def _write(self, topic: str, message: Any, now_ns: int) -> None:
        kind = outputs.RECORDED_TYPES[topic]
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                f"/{topic}", kind, typestore=self._store, offered_qos_profiles=[LATCHED]
            )
        raw = self._store.serialize_cdr(message, kind)
        with writing(self._path, ReplayError):
            self._writer.write(self._connections[topic], now_ns, raw)
