# SPDX-License-Identifier: Apache-2.0
"""The map topics: ``CellMap`` to and from the bytes of ``map/cells``, sites to their messages.

Live nodes and replay run the landing site selection on ``decode_cells(encode_cells(...))``, so
that what was rounded on the way to the wire was rounded for both.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.config.limits import MOST_LEAVES, MOST_LEVELS, why_too_much
from quadtree_lss.onboard.config.settings import ConfigError, LssConfig, checked_values
from quadtree_lss.onboard.core.geometry.bounds import MAX_HEIGHT, MAX_VALUE, clamp_heights
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.columns import pack
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.core.tree.leaves import leaf_raster
from quadtree_lss.onboard.core.tree.soundness import sound_planes
from quadtree_lss.onboard.messages.clouds import MessageError

if TYPE_CHECKING:  # the sites' modules are slow to load, and mapping_node needs none
    from quadtree_lss.onboard.core.landing.result import LandingAssessment


#: ``sensor_msgs/PointField`` datatype of a NumPy scalar type.
POINT_FIELD_TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}

_I, _J = np.triu_indices(3)
_UPPER = [f"{i}{j}" for i, j in zip(_I, _J, strict=True)]
_OF_UPPER = [0, 1, 2, 1, 3, 4, 2, 4, 5]
"""Of a symmetric matrix (3, 3) row by row, where its entries are among those of `_UPPER`."""
_RANGE = tuple(f"covariance_range_{of}" for of in _UPPER)
_POSE = tuple(f"covariance_pose_{of}" for of in _UPPER)
_NORMAL = ("normal_x", "normal_y", "normal_z")
_FEATURE = ("feature_a", "feature_k", "feature_x", "feature_y", "feature_sigma")
_PLANE = ("size", "elevation", *_NORMAL)
_REST = (*_RANGE, *_POSE, "roughness", "exception_fraction", *_FEATURE)
_SAME = "x y count ix iy level measured offset_z offset_variance low high coverage".split()
"""Fields that are attributes of a `CellMap`, but for those of `pack`."""


def record_dtype(*columns: tuple[str, Iterable[str]]) -> np.dtype[np.void]:
    """Packed little-endian records: types, each with the names of its fields."""
    return np.dtype([(name, "<" + kind) for kind, names in columns for name in names])


#: A ``map/cells`` point.
CELL_FIELDS = record_dtype(
    ("f4", "xyz"),
    ("f8", _PLANE),
    ("f4", _REST),
    ("u4", ["count"]),
    ("u2", ("ix", "iy")),
    ("u1", ("level", "min_level", "measured")),
    ("f4", ("offset_z", "offset_variance")),
    ("f8", ("low", "high")),
    ("f4", ["coverage"]),
)

#: Values of ``map/observed``: mapped, seen but not yet mapped, no point fell there.
KNOWN, SEEN, NOT_SEEN = 100, 50, -1

#: A ``landing/site_table`` point.
SITE_FIELDS = record_dtype(
    ("f4", (*"xyz", "score", "slope", "roughness", "hazard_distance", "subscale_height")),
    ("u4", ("id", "answer")),
    ("f4", ["probability"]),
)

_NOW = ("now_x", "now_y", "now_z", "now_probability")
#: The one ``landing/status`` point.
STATUS_FIELDS = record_dtype(
    ("f4", (*"xyz", "hazard_distance", "age", "offset_z", "offset_variance")),
    ("u4", ("id", "answer")),
    ("u1", ("reason", "state")),
    ("f4", ("seen", "probability")),
    ("u1", ["doubts"]),
    ("f4", _NOW),
)


def encode_cells(cells: CellMap) -> NDArray[np.void]:
    """One record per leaf, (M,) of `CELL_FIELDS`."""
    out = np.empty(len(cells.level), dtype=CELL_FIELDS)
    for name in _SAME:
        out[name] = getattr(cells, name)
    out["z"] = clamp_heights(cells.z, cells.low, cells.high)
    out["min_level"] = cells.domain.min_level
    pack(cells, _block(out, _PLANE), _block(out, _REST))
    return out


def decode_cells(
    records: NDArray[np.void],
    observed: Mask,
    xmin: float,
    ymin: float,
    stamp_ns: int,
    lss: LssConfig | None = None,
    known: Mask | None = None,
) -> CellMap:
    """The map from its two messages.

    Args:
        records: (M,) of `CELL_FIELDS`.
        observed: (n, n) [iy, ix] of ``map/observed``, of origin ``xmin``, ``ymin``, m.
        stamp_ns: Stamp that both messages carry.
        lss: How landing will be judged on it; None if it will not.
        known: (n, n) where ``map/observed`` does not say that the ground is not yet mapped; None
            for nowhere.

    Raises:
        MessageError: sizes do not fit, the leaves do not tile the domain, or landing sites
            cannot be computed on a map so large (``too_large``).
    """
    n = observed.shape[0]
    if observed.shape != (n, n) or n < 1 or n & (n - 1):
        msg = f"map/observed is {observed.shape[1]} x {n} cells, not a square power of two"
        raise MessageError("observed_shape", msg)
    if not len(records):
        msg = "map/cells has no leaves"
        raise MessageError("no_cells", msg)
    if n > 1 << MOST_LEVELS or len(records) > MOST_LEAVES:
        msg = (
            f"map of {len(records)} leaves on {n} x {n} finest cells: {MOST_LEAVES} leaves and"
            f" {1 << MOST_LEVELS} cells a side are the most"
        )
        raise MessageError("too_large", msg)
    level = records["level"].copy()  # kernels take nothing that is read-only
    ix, iy = records["ix"].astype(np.uint32), records["iy"].astype(np.uint32)
    domain = _tiled(records, n, xmin, ymin, lss)
    raster = np.full((n, n), -1, dtype=np.int32)
    leaf_raster(level, ix, iy, raster)
    if (raster < 0).any():
        msg = "map/cells has leaves that overlap"
        raise MessageError("tiling", msg)
    measured, elevation = records["measured"] > 0, records["elevation"].astype(np.float64)
    double = ("low", "high", "coverage", "roughness", "exception_fraction")
    cells = CellMap(
        stamp_ns=stamp_ns,
        domain=domain,
        level=level,
        ix=ix,
        iy=iy,
        z=elevation,
        normal=_block(records, _NORMAL).astype(float),
        covariance_range=_matrices(records, _RANGE),
        covariance_pose=_matrices(records, _POSE),
        count=records["count"].astype(np.uint32),
        measured=measured,
        feature=_block(records, _FEATURE).astype(float),
        observed=observed,
        known=observed & np.isfinite(elevation)[raster] & (True if known is None else known),
        offset_z=float(records["offset_z"][0]),
        offset_variance=float(records["offset_variance"][0]),
        **{name: records[name].astype(np.float64) for name in double},
    )
    _check(cells)
    return cells


def _tiled(
    records: NDArray[np.void], n: int, xmin: float, ymin: float, lss: LssConfig | None
) -> Domain:
    """The domain of n x n finest cells that leaves as large as these may tile; arguments and errors
    as of `decode_cells`."""
    level, max_level = records["level"], n.bit_length() - 1
    far = np.maximum(records["ix"], records["iy"]).astype(np.uint32)
    beyond = (level > max_level) | (far >> np.minimum(level, 31) > 0)
    if beyond.any() or np.sum(0.25 ** level.astype(np.float64)) != 1.0:
        msg = f"map/cells does not tile a domain of {n} x {n} finest cells"
        raise MessageError("tiling", msg)
    size = float(records["size"][0]) * float(1 << int(level[0]))
    domain = Domain(float(xmin), float(ymin), size, int(records["min_level"][0]), max_level)
    try:
        checked_values({f"domain.{name}": value for name, value in vars(domain).items()})
    except ConfigError as error:
        msg = f"map/cells is of a domain that none can be: {error}"
        raise MessageError("domain", msg) from None
    reason = None if lss is None else why_too_much(size, n, lss)
    if reason is not None:
        msg = f"map of {size:g} m: {reason}"
        raise MessageError("too_large", msg)
    if domain.min_level > max_level or not np.array_equal(records["size"], domain.cell_size(level)):
        msg = "map/cells has leaves whose size does not follow from their level"
        raise MessageError("domain", msg)
    return domain


def _check(cells: CellMap) -> None:
    """Refuse estimates that none can be. Raises `MessageError`: reason ``values``."""
    known = cells.estimated
    parts = cells.covariance_range, cells.covariance_pose
    sound = sound_planes(cells.z, cells.normal, *parts, cells.feature)
    sound &= ~cells.measured | ((cells.roughness >= 0.0) & (cells.roughness < MAX_VALUE))
    off = (cells.offset_z, cells.offset_variance)
    sound_offset = np.isnan(off).all() or (abs(off[0]) < MAX_HEIGHT and 0.0 <= off[1] < MAX_VALUE)
    if not sound_offset:
        msg = f"map/cells has an impossible offset: {off[0]} m of variance {off[1]}"
        raise MessageError("values", msg)
    if not sound[known].all() or cells.measured[~known].any():
        msg = "map/cells has a leaf with an impossible plane (normal, elevation, covariance)"
        raise MessageError("values", msg)
    if not ((cells.coverage >= 0.0) & (cells.coverage <= 1.0)).all():
        msg = "map/cells has a leaf with an impossible coverage"
        raise MessageError("values", msg)
    bounds = np.stack([cells.low, cells.high])
    if (np.abs(bounds) >= MAX_HEIGHT).any() or (cells.low > cells.high).any():
        msg = "map/cells has a leaf with impossible bounds (low, high)"
        raise MessageError("values", msg)


def _block(records: NDArray[np.void], names: Sequence[str]) -> NDArray[Any]:
    """(M, K) of fields of one type that lie side by side: of contiguous records a view, which is
    read at once, in a fourth of the time."""
    kind, start = (records.dtype.fields or {})[names[0]][:2]
    shape, strides = (len(records), len(names)), (records.itemsize, kind.itemsize)
    return np.ndarray(shape, kind, np.ascontiguousarray(records), start, strides)


def _matrices(records: NDArray[np.void], names: Sequence[str]) -> Array:
    return _block(records, names).astype(float).take(_OF_UPPER, axis=1).reshape(-1, 3, 3)


def round_trip(cells: CellMap) -> CellMap:
    """The map as a subscriber gets it: some columns in single precision."""
    names = "covariance_range covariance_pose coverage roughness exception_fraction feature".split()
    single = {name: getattr(cells, name).astype(np.float32).astype(np.float64) for name in names}
    offset, variance = map(float, np.float32([cells.offset_z, cells.offset_variance]))
    return replace(cells, **single, offset_z=offset, offset_variance=variance)


def encode_sites(assessment: LandingAssessment) -> NDArray[np.void]:
    """One record per ranked site, (K,) of `SITE_FIELDS`, best first."""
    sites = assessment.sites
    out = np.zeros(len(sites.score), dtype=SITE_FIELDS)
    _block(out, "xyz")[:] = sites.position
    for name in ("score", "roughness", "hazard_distance", "subscale_height", "id", "probability"):
        out[name] = getattr(sites, name)
    out["slope"], out["answer"] = np.radians(sites.slope_deg), assessment.number
    return out


def encode_status(assessment: LandingAssessment, age: float) -> NDArray[np.void]:
    """The one record (1,). ``assessment``: the answer. ``age``: of its map when it is sent, s; NaN
    if unknown."""
    selected = assessment.selected
    out = np.zeros(1, dtype=STATUS_FIELDS)
    _block(out, "xyz")[:] = selected.position
    _block(out, _NOW)[:] = assessment.now
    for name in ("offset_z", "offset_variance", "seen"):
        out[name] = getattr(assessment, name)
    for name in ("id", "reason", "state", "probability"):
        out[name] = getattr(selected, name)
    out["hazard_distance"] = selected.site.hazard_distance if selected.id else np.nan
    out["age"], out["answer"], out["doubts"] = age, assessment.number, len(assessment.warnings)
    return out


def encode_observed(observed: Mask, known: Mask) -> NDArray[np.int8]:
    """OccupancyGrid values of ``map/observed``: 100 mapped, 50 seen, not yet mapped, -1 unseen."""
    out = np.where(observed, np.int8(SEEN), np.int8(NOT_SEEN))
    out[observed & known] = KNOWN
    return out


def decode_observed(values: NDArray[np.int8]) -> tuple[Mask, Mask]:
    """Where a point fell, and where it may be part of the map."""
    return values > 0, values > SEEN


_HAZARD_VALUES = np.full(256, 100, dtype=np.int8)
_HAZARD_VALUES[0x20::0x20] = -1  # only bits of ground that is not known
_HAZARD_VALUES[0] = 0
"""Of ``landing/hazards`` by the bits of a grid point."""


def encode_hazards(assessment: LandingAssessment) -> NDArray[np.int8]:
    """OccupancyGrid values of ``landing/hazards``: 0, 100 hazard, -1 unknown; (ny, nx)."""
    return _HAZARD_VALUES[assessment.hazard]


def encode_score(assessment: LandingAssessment) -> NDArray[np.int8]:
    """OccupancyGrid values of ``landing/score``: best 0 to worst 99, 100 excluded; (ny, nx)."""
    allowed = np.isfinite(assessment.score)
    score = assessment.score[allowed]
    out = np.full(allowed.shape, 100, dtype=np.int8)
    if score.size:
        low, high = float(score.min()), float(score.max())
        span = max(high - low, 1e-12)
        out[allowed] = np.rint(99.0 * (score - low) / span).astype(np.int8)
    return out


def encode_probability(assessment: LandingAssessment) -> NDArray[np.int8]:
    """OccupancyGrid values of ``landing/probability``: per cent, rounded down; -1 if unknown."""
    share = known_probability(assessment)
    percent = np.floor(100.0 * np.minimum(share, 1.0) + 1e-9)
    return np.where(share >= 0.0, percent, -1.0).astype(np.int8)


def known_probability(assessment: LandingAssessment) -> Array:
    """(ny, nx) of a safe touchdown if the lander aims at the grid point; NaN where it is unseen."""
    return np.where(assessment.hazard & 0x80 > 0, np.nan, assessment.probability)


def site_orientations(normals: Array) -> Array:
    """Quaternions (K, 4) x, y, z, w that take +z to the normals (K, 3), +x in the map's x-z plane.

    The x axis is the direction (n_z, 0, -n_x), perpendicular to the normal and without a y part.
    """
    from quadtree_lss.onboard.core.geometry.rotations import quaternion_from_rotation

    z = np.asarray(normals, dtype=np.float64).reshape(-1, 3)
    x = np.stack([z[:, 2], np.zeros(len(z)), -z[:, 0]], axis=-1)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return quaternion_from_rotation(np.stack([x, np.cross(z, x), z], axis=-1))
