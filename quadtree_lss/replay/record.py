# SPDX-License-Identifier: Apache-2.0
"""What the nodes would have published on a bag, as a bag: maps and landing sites in its time."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.errors import WriterError

from quadtree_lss.config.settings import Config
from quadtree_lss.core.landing.sites import LandingSiteSelector
from quadtree_lss.core.tree.cell_map import CellMap
from quadtree_lss.messages.maps import round_trip
from quadtree_lss.messages.outputs import TOPIC_TYPES, MessageMaker
from quadtree_lss.replay.stream import ReplayError
from quadtree_lss.replay.types import typestore

_NO_TIME = QosTime(0, 0)
LATCHED = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    _NO_TIME,
    _NO_TIME,
    QosLiveliness.AUTOMATIC,
    _NO_TIME,
    False,
)
"""So that `ros2 bag play` serves late subscribers, as the nodes do."""


class Recorder:
    """Context manager that writes the output topics into a new mcap bag.

    Maps go out at most ``publish.rate`` times a second of the bag's time, landing sites at most
    ``publish.lss_rate`` times, and the last state always, as the nodes do it.

    Args:
        path: Folder to write, which must not exist.
        config: Rates, frame and everything about landing sites.
        maps: Write maps too; not for a bag that holds them already.

    Attributes:
        restrictions: Gives what is asked of landing, as keywords of ``assess``.

    Raises:
        ReplayError: ``path`` exists or cannot be written.
    """

    def __init__(self, path: Path, config: Config, *, maps: bool = True) -> None:
        self._path, self._maps = path, maps
        self._writer = self._open()
        self._store = typestore(ros1=False)
        self._messages = MessageMaker(self._store.types, np.asarray, config.frames.map)
        self._selector = LandingSiteSelector(config)
        self._connections: dict[str, Any] = {}
        self._map = _Clock(config.publish.rate)
        self._landing = _Clock(config.publish.lss_rate)
        self._cells: CellMap | None = None
        self.restrictions: Callable[[], dict[str, Any]] = dict

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()
        if not self._connections:  # an empty bag is of no use
            shutil.rmtree(self._path, ignore_errors=True)

    def changed(self) -> None:
        """There is a new map."""
        self._map.changed = True

    def landing_changed(self) -> None:
        """Something else is asked of landing: ``restrictions`` tells what."""
        self._landing.changed = True

    def tick(self, now_ns: int, snapshot: Callable[[], CellMap]) -> None:
        """Writes what is due at a time of the bag."""
        if self._map.due(now_ns):
            self._write_map(now_ns, snapshot())
        if self._landing.due(now_ns):
            self._write_landing(now_ns)

    def finish(self, now_ns: int, snapshot: Callable[[], CellMap]) -> None:
        """Writes the last state, however soon it comes after the one before."""
        if self._map.changed:
            self._write_map(now_ns, snapshot())
        if self._landing.changed:
            self._write_landing(now_ns)

    def _open(self) -> Writer:
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            writer = Writer(self._path, version=9, storage_plugin=StoragePlugin.MCAP)
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            writer.open()
        except (WriterError, OSError) as error:
            text = str(error)
            if isinstance(error, OSError) and error.strerror:
                text = f"{error.filename}: {error.strerror}"
            if self._path.exists():
                text = "it exists already"
            msg = f"--record {self._path}: cannot be written: {text}"
            raise ReplayError(msg) from None
        return writer

    def _write_map(self, now_ns: int, cells: CellMap) -> None:
        self._map.sent(now_ns)
        self._cells = round_trip(cells)
        self._landing.changed = True
        if self._maps:
            for topic, message in self._messages.of_map(cells):
                self._write(topic, message, now_ns)

    def _write_landing(self, now_ns: int) -> None:
        self._landing.sent(now_ns)
        if self._cells is not None:
            found = self._selector.assess(self._cells, **self.restrictions())
            for topic, message in self._messages.of_landing(found):
                self._write(topic, message, now_ns)

    def _write(self, topic: str, message: Any, now_ns: int) -> None:
        kind = TOPIC_TYPES[topic]
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                f"/{topic}", kind, typestore=self._store, offered_qos_profiles=[LATCHED]
            )
        raw = self._store.serialize_cdr(message, kind)
        self._writer.write(self._connections[topic], now_ns, raw)


class _Clock:
    """Whether a change is due at a rate in Hz."""

    def __init__(self, rate: float) -> None:
        self._period_ns = round(1e9 / rate)
        self._due_ns = 0
        self.changed = False

    def due(self, now_ns: int) -> bool:
        return self.changed and now_ns >= self._due_ns

    def sent(self, now_ns: int) -> None:
        self.changed = False
        self._due_ns = now_ns + self._period_ns
