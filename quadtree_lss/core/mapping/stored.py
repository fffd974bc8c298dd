# SPDX-License-Identifier: Apache-2.0
"""Measurements that wait in their cell until they suffice for a fit (paper IV.A)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core.sensing.register import RegisteredScan

Array = NDArray[np.float64]
Index = NDArray[np.intp]


class StoredPoints:
    """Bounded pool of points, each with its leaf and its scan.

    Attributes:
        row: (K,) leaf of each point.
        scan: (K,) key of the scan it belongs to; each scan has its own offset gamma_j.
        points: (3, K) map frame, m.
        per_row: (capacity,) stored points of each leaf.
        refused: Points that found no room, in total.
    """

    def __init__(self, max_total: int, max_per_row: int) -> None:
        self.max_total = max_total
        self.max_per_row = max_per_row
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self.row: Index = np.empty(0, dtype=np.intp)
        self.scan: Index = np.empty(0, dtype=np.intp)
        self.points: Array = np.empty((3, 0))
        self.per_row: Index = np.zeros(64, dtype=np.intp)
        self.refused = 0
        self._next_scan = 0
        self._positions: dict[int, Array] = {}
        self._roots: dict[int, Array] = {}

    def export_state(self) -> dict[str, NDArray[Any]]:
        """The pool with the poses its points were seen from; copies."""
        keys = np.unique(self.scan)
        positions, roots = self.poses(keys)
        return {
            "row": self.row.copy(),
            "scan": self.scan.copy(),
            "points": self.points.copy(),
            "keys": keys,
            "positions": positions,
            "roots": roots,
            "next_scan": np.array(self._next_scan),
        }

    def import_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Take up the pool of `export_state`."""
        self.clear()
        self.row, self.scan = state["row"].astype(np.intp), state["scan"].astype(np.intp)
        self.points = state["points"].astype(np.float64)
        counted = np.bincount(self.row, minlength=len(self.per_row))
        self.per_row = counted.astype(np.intp)
        self._next_scan = int(state["next_scan"])
        keys = state["keys"].tolist()
        self._positions = dict(zip(keys, state["positions"], strict=True))
        self._roots = dict(zip(keys, state["roots"], strict=True))

    def counts(self, rows: Index, capacity: int) -> Index:
        """Stored points of leaves ``rows`` in a tree that has ``capacity`` rows."""
        if capacity > len(self.per_row):
            grown = np.zeros(capacity, dtype=np.intp)
            grown[: len(self.per_row)] = self.per_row
            self.per_row = grown
        return self.per_row[rows]

    def poses(self, scans: Index) -> tuple[Array, Array]:
        """Lidar positions (S, 3) and covariance roots (S, 6, 6) of scan keys (S,)."""
        keys = scans.tolist()
        positions = np.array([self._positions[key] for key in keys]).reshape(-1, 3)
        return positions, np.array([self._roots[key] for key in keys]).reshape(-1, 6, 6)

    def open_scan(self, scan: RegisteredScan) -> int:
        """Key under which points of this scan are stored."""
        key = self._next_scan
        self._next_scan += 1
        self._positions[key], self._roots[key] = scan.pose.position, scan.pose_root
        return key

    def add(self, rows: Index, key: int, points: Array) -> None:
        """Store points (3, K) of one scan in leaves ``rows`` (K,) as far as there is room."""
        order = np.argsort(rows, kind="stable")
        ordered = rows[order]
        first = np.flatnonzero(np.r_[True, ordered[1:] != ordered[:-1]])
        rank = np.arange(len(rows)) - np.repeat(first, np.diff(np.r_[first, len(rows)]))
        fits = order[rank + self.per_row[ordered] < self.max_per_row]
        fits = np.sort(fits)[: max(self.max_total - len(self.row), 0)]
        self.refused += len(rows) - len(fits)
        if not len(fits):
            return
        self.row = np.concatenate([self.row, rows[fits]])
        self.scan = np.concatenate([self.scan, np.full(len(fits), key, dtype=np.intp)])
        self.points = np.concatenate([self.points, points[:, fits]], axis=1)
        np.add.at(self.per_row, rows[fits], 1)

    def lift(self, height: float) -> None:
        """Move all stored points up by ``height``, m.

        The places they were seen from stay: centimetres do not turn a ray of hundreds of metres.
        """
        self.points[2] += height

    def of(self, rows: Index) -> Index:
        """Indices into the pool of the points of leaves ``rows``."""
        wanted = np.zeros(len(self.per_row), dtype=np.bool_)
        wanted[rows] = True
        return np.flatnonzero(wanted[self.row])

    def drop(self, rows: Index) -> None:
        """Forget the points of leaves ``rows``, and poses of scans that have none left."""
        if not len(rows) or not len(self.row):
            return
        gone = np.zeros(len(self.per_row), dtype=np.bool_)
        gone[rows] = True
        kept = ~gone[self.row]
        self.row, self.scan = self.row[kept], self.scan[kept]
        self.points = self.points[:, kept]
        self.per_row[rows] = 0

    def close_scan(self) -> None:
        """Forget the poses of scans without stored points."""
        live = set(np.unique(self.scan).tolist())
        for key in [key for key in self._positions if key not in live]:
            del self._positions[key], self._roots[key]
