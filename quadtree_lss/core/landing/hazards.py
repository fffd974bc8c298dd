# SPDX-License-Identifier: Apache-2.0
"""Avoided features of leaves (paper V.B): slope, elevation, exception."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.config.settings import LssConfig
from quadtree_lss.core.landing.ancestors import fuse_to_level
from quadtree_lss.core.tree.quadtree import CellMap

Array = NDArray[np.float64]
Bits = NDArray[np.uint8]
Index = NDArray[np.intp]

SLOPE, ELEVATION, EXCEPTION, TOUCHDOWN, UNSEEN = 1, 2, 4, 8, 128


def slope(normal: Array) -> Array:
    """Eq. 54: angle in rad between normals (..., 3) and the vertical."""
    return np.arctan2(np.hypot(normal[..., 0], normal[..., 1]), normal[..., 2])


def reference_level(cells: CellMap, reference_size: float) -> int:
    """Level whose cells are nearest in size to ``reference_size`` (m), within the tree."""
    ratio = cells.domain.size / reference_size
    level = int(np.rint(np.log2(max(ratio, 1.0))))
    return min(level, cells.domain.max_level)


def elevation_deviation(cells: CellMap, level: int) -> Array:
    """Greatest distance (M,), m, of each leaf's plane from the fused plane of a higher level.

    Both are planes, so their distance over the leaf's square is greatest at a corner; it is
    measured along the fused plane's normal. 0 for leaves of the level or above, and NaN for
    leaves without a plane.
    """
    fused = fuse_to_level(cells, level)
    out = np.where(cells.estimated, 0.0, np.nan)
    chosen = np.flatnonzero((fused.of_leaf >= 0) & (cells.level > level) & cells.estimated)
    above = fused.of_leaf[chosen]
    normal, flat = cells.normal[chosen], fused.normal[above]
    half = 0.5 * cells.size[chosen]
    greatest = np.zeros(len(chosen))
    for right in (-1.0, 1.0):
        for up in (-1.0, 1.0):
            dx, dy = right * half, up * half
            dz = -(normal[:, 0] * dx + normal[:, 1] * dy) / normal[:, 2]
            distance = (
                flat[:, 0] * (cells.x[chosen] + dx - fused.x[above])
                + flat[:, 1] * (cells.y[chosen] + dy - fused.y[above])
                + flat[:, 2] * (cells.z[chosen] + dz - fused.z[above])
            )
            np.maximum(greatest, np.abs(distance), out=greatest)
    out[chosen] = greatest
    return out


def avoided_features(cells: CellMap, config: LssConfig) -> Bits:
    """Bits (M,) of the avoided features each leaf contains; unmeasured leaves have none."""
    level = reference_level(cells, config.elevation_reference_size)
    with np.errstate(invalid="ignore"):
        steep = slope(cells.normal) > np.radians(config.max_slope_deg)
        raised = elevation_deviation(cells, level) > config.max_roughness
        excepted = cells.exception_fraction > config.max_exception_fraction
    bits = SLOPE * steep + ELEVATION * raised + EXCEPTION * excepted
    return np.where(cells.measured, bits, 0).astype(np.uint8)


class LeafHazards:
    """Avoided features of maps of a growing terrain; finds anew only those that may have changed.

    A leaf's features depend on the leaves that its ancestor of the reference level covers. Where
    none of these changed, the bits are the ones of before, bit for bit.
    """

    def __init__(self, config: LssConfig) -> None:
        self.config = config
        self._cells: CellMap | None = None
        self._bits: Bits = np.zeros(0, dtype=np.uint8)

    def of(self, cells: CellMap) -> Bits:
        """``avoided_features`` (M,) of a map."""
        bits = np.zeros(len(cells.level), dtype=np.uint8)
        due = np.ones(len(bits), dtype=np.bool_)
        if self._cells is not None and self._cells.domain == cells.domain:
            level = reference_level(cells, self.config.elevation_reference_size)
            now, before = _unchanged(cells, self._cells, level)
            bits[now], due[now] = self._bits[before], False
        rows = np.flatnonzero(due)
        if len(rows) == len(due):
            bits = avoided_features(cells, self.config)
        elif len(rows):
            bits[rows] = avoided_features(_part(cells, rows), self.config)
        self._cells, self._bits = cells, bits
        return bits


def _unchanged(cells: CellMap, other: CellMap, level: int) -> tuple[Index, Index]:
    """Rows of leaves in either map whose ancestor of ``level`` covers the same leaves in both."""
    number = 1 << 2 * level
    key, other_key = _ancestor(cells, level), _ancestor(other, level)
    count = np.bincount(key, minlength=number)
    other_count = np.bincount(other_key, minlength=number)
    same = count == other_count
    order, other_order = np.argsort(key, kind="stable"), np.argsort(other_key, kind="stable")
    rows = order[same[key[order]]]
    other_rows = other_order[same[other_key[other_order]]]
    differs = (_estimates(cells)[rows] != _estimates(other)[other_rows]).any(axis=1)
    same[key[rows[differs]]] = False
    kept = same[key[rows]]
    return rows[kept], other_rows[kept]


def _ancestor(cells: CellMap, level: int) -> Index:
    """Number (M,) of each leaf's ancestor of ``level``, the first one below for larger leaves."""
    down = cells.level.astype(np.intp) - level
    ix, iy = (
        np.where(down < 0, v.astype(np.intp) << np.maximum(-down, 0), v >> np.maximum(down, 0))
        for v in (cells.ix, cells.iy)
    )
    return np.asarray((iy << level) + ix, dtype=np.intp)


def _estimates(cells: CellMap) -> NDArray[np.int64]:
    """What a leaf's features are found from, (M, 18); the same bits are the same numbers."""
    columns = (cells.level, cells.ix, cells.iy, cells.z, cells.count, cells.measured)
    table = np.column_stack(
        [
            *columns,
            cells.exception_fraction,
            cells.normal,
            cells.covariance_range.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]],
        ]
    )
    return np.ascontiguousarray(table, dtype=np.float64).view(np.int64)


def _part(cells: CellMap, rows: Index) -> CellMap:
    """A map of some leaves alone."""
    whole = {"stamp_ns", "domain", "observed"}
    names = [f.name for f in fields(cells) if f.name not in whole]
    return replace(cells, **{name: getattr(cells, name)[rows] for name in names})
