# SPDX-License-Identifier: Apache-2.0
"""Encoding of maps and assessments as records and grids, and decoding of maps.

Live nodes and replay select landing sites on ``decode_cells(encode_cells(...))``, so that both use
the same rounded values.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.config.limits import MAX_LEAVES, MAX_LEVEL, exceeded_limit
from quadtree_lss.onboard.config.settings import ConfigError, LssConfig, checked_values
from quadtree_lss.onboard.core.geometry.bounds import MAX_HEIGHT, MAX_VALUE, clamp_heights
from quadtree_lss.onboard.core.geometry.rotations import quaternion_from_rotation
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.columns import sound_planes
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.core.tree.leaves import leaf_raster
from quadtree_lss.onboard.messages.clouds import MessageError

if TYPE_CHECKING:  # the sites' modules are slow to load, and mapping_node needs none
    from quadtree_lss.onboard.core.landing.result import LandingAssessment


#: ``sensor_msgs/PointField`` datatype of a NumPy scalar type.
POINT_FIELD_TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}

_UPPER = ("00", "01", "02", "11", "12", "22")
"""Row and column of the entries stored of a symmetric 3 x 3 matrix."""
_UPPER_INDICES = [0, 1, 2, 1, 3, 4, 2, 4, 5]
"""Index in `_UPPER` of each entry of the matrix, row by row."""
_RANGE = tuple(f"covariance_range_{entry}" for entry in _UPPER)
_POSE = tuple(f"covariance_pose_{entry}" for entry in _UPPER)
_NORMAL = ("normal_x", "normal_y", "normal_z")
_FEATURE = ("feature_a", "feature_k", "feature_x", "feature_y", "feature_sigma")
_ATTRIBUTES = "x y size roughness exception_fraction count ix iy level measured".split()
_ATTRIBUTES += "offset_z offset_variance low high coverage".split()
"""Fields with the name of a `CellMap` attribute."""


def record_dtype(*columns: tuple[str, Iterable[str]]) -> np.dtype[np.void]:
    """Return packed little-endian records of fields given by type and names."""
    return np.dtype([(name, "<" + kind) for kind, names in columns for name in names])


#: A ``map/cells`` point.
CELL_FIELDS = record_dtype(
    ("f4", "xyz"),
    ("f8", ("size", "elevation", *_NORMAL)),
    ("f4", (*_RANGE, *_POSE, "roughness", "exception_fraction", *_FEATURE)),
    ("u4", ["count"]),
    ("u2", ("ix", "iy")),
    ("u1", ("level", "min_level", "measured")),
    ("f4", ("offset_z", "offset_variance")),
    ("f8", ("low", "high")),
    ("f4", ["coverage"]),
)

#: Values of ``map/observed``: mapped; observed, not yet mapped; not observed.
MAPPED, OBSERVED, UNOBSERVED = 100, 50, -1

#: A ``landing/site_table`` point.
SITE_FIELDS = record_dtype(
    ("f4", (*"xyz", "score", "slope", "roughness", "hazard_distance", "subscale_height")),
    ("u4", ("id", "answer")),
    ("f4", ["probability"]),
)

_NOW = ("now_x", "now_y", "now_z", "now_probability")
#: The only ``landing/status`` point.
STATUS_FIELDS = record_dtype(
    ("f4", (*"xyz", "hazard_distance", "age", "offset_z", "offset_variance")),
    ("u4", ("id", "answer")),
    ("u1", ("reason", "state")),
    ("f4", ("seen", "probability")),
    ("u1", ["doubts"]),
    ("f4", _NOW),
)


def encode_cells(cells: CellMap) -> NDArray[np.void]:
    """Return one record per leaf, (M,) of `CELL_FIELDS`."""
    out = np.empty(len(cells.level), dtype=CELL_FIELDS)
    for name in _ATTRIBUTES:
        out[name] = getattr(cells, name)
    out["z"] = clamp_heights(cells.z, cells.low, cells.high)
    out["min_level"] = cells.domain.min_level
    out["elevation"] = cells.z
    _block(out, _NORMAL)[:] = cells.normal
    _block(out, _FEATURE)[:] = cells.feature
    row, column = np.triu_indices(3)
    _block(out, _RANGE)[:] = cells.covariance_range[:, row, column]
    _block(out, _POSE)[:] = cells.covariance_pose[:, row, column]
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
    """Build the map from the content of its two messages.

    ``records``: (M,) of `CELL_FIELDS`. ``observed``: (n, n) [iy, ix], True where a point fell.
    ``known``: (n, n), False where the ground is not yet mapped; None if it is mapped everywhere.
    ``lss``: settings for landing-site selection on the map, None if there is none. Raises
    `MessageError` if the sizes are inconsistent, the leaves do not tile the domain, a value is
    impossible, or the map is too large for landing-site selection (``too_large``).
    """
    n = observed.shape[0]
    if observed.shape != (n, n) or n < 1 or n & (n - 1):
        msg = f"map/observed is {observed.shape[1]} x {n} cells, not a square power of two"
        raise MessageError("observed_shape", msg)
    if not len(records):
        msg = "map/cells has no leaves"
        raise MessageError("no_cells", msg)
    if n > 1 << MAX_LEVEL or len(records) > MAX_LEAVES:
        msg = f"map of {len(records)} leaves on {n} x {n} finest cells:"
        msg += f" {MAX_LEAVES} leaves and {1 << MAX_LEVEL} cells a side are the most"
        raise MessageError("too_large", msg)
    level = records["level"].copy()  # kernels need writable arrays
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
    """Return the domain of n x n finest cells that the leaves tile, by the sum of their areas."""
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
        msg = f"map/cells has an invalid domain: {error}"
        raise MessageError("domain", msg) from None
    reason = None if lss is None else exceeded_limit(size, n, lss)
    if reason is not None:
        msg = f"map of {size:g} m: {reason}"
        raise MessageError("too_large", msg)
    if domain.min_level > max_level or not np.array_equal(records["size"], domain.cell_size(level)):
        msg = "map/cells has leaves whose size does not follow from their level"
        raise MessageError("domain", msg)
    return domain


def _check(cells: CellMap) -> None:
    """Raise `MessageError` with reason ``values`` if an estimate is impossible."""
    known = cells.estimated
    covariances = cells.covariance_range, cells.covariance_pose
    sound = sound_planes(cells.z, cells.normal, *covariances, cells.feature)
    sound &= ~cells.measured | ((cells.roughness >= 0.0) & (cells.roughness < MAX_VALUE))
    offset, variance = cells.offset_z, cells.offset_variance
    possible = abs(offset) < MAX_HEIGHT and 0.0 <= variance < MAX_VALUE
    if not (possible or np.isnan((offset, variance)).all()):
        msg = f"map/cells has an impossible offset: {offset} m of variance {variance}"
        raise MessageError("values", msg)
    bounds = np.abs([cells.low, cells.high])
    impossible = {
        "plane (normal, elevation, covariance)": ~np.where(known, sound, ~cells.measured),
        "coverage": ~((cells.coverage >= 0.0) & (cells.coverage <= 1.0)),
        "bounds (low, high)": (bounds >= MAX_HEIGHT).any(axis=0) | (cells.low > cells.high),
    }
    for what, leaves in impossible.items():
        if leaves.any():
            raise MessageError("values", f"map/cells has a leaf with an impossible {what}")


def _block(records: NDArray[np.void], names: Sequence[str]) -> NDArray[Any]:
    """View adjacent fields of one type as (M, K); of contiguous records without a copy, which is
    four times as fast as reading field by field."""
    kind, start = (records.dtype.fields or {})[names[0]][:2]
    shape, strides = (len(records), len(names)), (records.itemsize, kind.itemsize)
    return np.ndarray(shape, kind, np.ascontiguousarray(records), start, strides)


def _matrices(records: NDArray[np.void], names: Sequence[str]) -> Array:
    return _block(records, names).astype(float).take(_UPPER_INDICES, axis=1).reshape(-1, 3, 3)


def round_trip(cells: CellMap) -> CellMap:
    """Round the columns that are sent in single precision, as in a received map."""
    names = "covariance_range covariance_pose coverage roughness exception_fraction feature".split()
    single = {name: getattr(cells, name).astype(np.float32).astype(np.float64) for name in names}
    offset, variance = map(float, np.float32([cells.offset_z, cells.offset_variance]))
    return replace(cells, **single, offset_z=offset, offset_variance=variance)


def encode_sites(assessment: LandingAssessment) -> NDArray[np.void]:
    """Return one record per ranked site, (K,) of `SITE_FIELDS`, best first."""
    sites = assessment.sites
    out = np.zeros(len(sites.score), dtype=SITE_FIELDS)
    _block(out, "xyz")[:] = sites.position
    for name in ("score", "roughness", "hazard_distance", "subscale_height", "id", "probability"):
        out[name] = getattr(sites, name)
    out["slope"], out["answer"] = np.radians(sites.slope_deg), assessment.number
    return out


def encode_status(assessment: LandingAssessment, age: float) -> NDArray[np.void]:
    """Return the record (1,) of an assessment. ``age``: age of its map when it is sent, s; NaN if
    unknown."""
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
    """Return the values of ``map/observed``, (n, n)."""
    out = np.where(observed, np.int8(OBSERVED), np.int8(UNOBSERVED))
    out[observed & known] = MAPPED
    return out


def decode_observed(values: NDArray[np.int8]) -> tuple[Mask, Mask]:
    """Return where a point fell, and where it can be part of the map."""
    return values > 0, values > OBSERVED


_HAZARD_VALUES = np.full(256, 100, dtype=np.int8)
_HAZARD_VALUES[0x20::0x20] = -1  # only bits of unmapped or unseen ground
_HAZARD_VALUES[0] = 0
"""Value of ``landing/hazards`` by the hazard bits of a grid point."""


def encode_hazards(assessment: LandingAssessment) -> NDArray[np.int8]:
    """Return the values of ``landing/hazards``, (ny, nx): 0 none, 100 hazard, -1 unknown."""
    return _HAZARD_VALUES[assessment.hazard]


def encode_score(assessment: LandingAssessment) -> NDArray[np.int8]:
    """Return the values of ``landing/score``, (ny, nx): 0 best to 99 worst, 100 excluded."""
    allowed = np.isfinite(assessment.score)
    score = assessment.score[allowed]
    out = np.full(allowed.shape, 100, dtype=np.int8)
    if score.size:
        low, high = float(score.min()), float(score.max())
        span = max(high - low, 1e-12)
        out[allowed] = np.rint(99.0 * (score - low) / span).astype(np.int8)
    return out


def encode_probability(assessment: LandingAssessment) -> NDArray[np.int8]:
    """Return the values of ``landing/probability``, (ny, nx): %, rounded down; -1 unknown."""
    share = known_probability(assessment)
    percent = np.floor(100.0 * np.minimum(share, 1.0) + 1e-9)
    return np.where(share >= 0.0, percent, -1.0).astype(np.int8)


def known_probability(assessment: LandingAssessment) -> Array:
    """Return the probability of success at each grid point, (ny, nx); NaN where unseen."""
    return np.where(assessment.hazard & 0x80 > 0, np.nan, assessment.probability)


def site_orientations(normals: Array) -> Array:
    """Return quaternions (K, 4) x, y, z, w that rotate +z to the normals (K, 3).

    The x axis is the direction (n_z, 0, -n_x), perpendicular to the normal and without a y part.
    """
    z = np.asarray(normals, dtype=np.float64).reshape(-1, 3)
    x = np.stack([z[:, 2], np.zeros(len(z)), -z[:, 0]], axis=-1)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return quaternion_from_rotation(np.stack([x, np.cross(z, x), z], axis=-1))
