# SPDX-License-Identifier: Apache-2.0
"""The map topics: ``CellMap`` to and from the bytes of ``map/cells``, sites to their messages.

Live nodes and replay run the landing site selection on ``decode_cells(encode_cells(...))``, so
that what was rounded on the way to the wire was rounded for both.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.config.limits import MOST_LEAVES, MOST_LEVELS, why_too_much
from quadtree_lss.onboard.config.settings import ConfigError, LssConfig, checked_values
from quadtree_lss.onboard.core.geometry.bounds import MOST, MOST_HEIGHT, bounded
from quadtree_lss.onboard.core.landing.target import WAIT_S
from quadtree_lss.onboard.core.tree.cell_map import CellMap, sound_planes
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.core.tree.leaves import leaf_raster
from quadtree_lss.onboard.messages.clouds import MessageError

if TYPE_CHECKING:  # the sites' modules are slow to load, and mapping_node needs none
    from quadtree_lss.onboard.core.landing.sites import LandingAssessment


#: sensor_msgs/PointField datatype of a NumPy scalar type.
POINT_FIELD_TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}

_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_RANGE = tuple(f"covariance_range_{i}{j}" for i, j in _UPPER)
_POSE = tuple(f"covariance_pose_{i}{j}" for i, j in _UPPER)
_NORMAL = ("normal_x", "normal_y", "normal_z")
_FEATURE = ("feature_a", "feature_k", "feature_x", "feature_y", "feature_sigma")


def _of(kind: str, names: str | tuple[str, ...]) -> tuple[tuple[str, str], ...]:
    """Fields of one little-endian type."""
    return tuple((name, kind) for name in (names.split() if isinstance(names, str) else names))


#: Name and type of each field of a ``map/cells`` point, in order.
CELL_FIELDS = (
    *_of("f4", "x y z"),
    *_of("f8", ("size", "elevation", *_NORMAL)),
    *_of("f4", (*_RANGE, *_POSE, "roughness", "exception_fraction", *_FEATURE)),
    *_of("u4", "count"),
    *_of("u2", "ix iy"),
    *_of("u1", "level min_level measured"),
    *_of("f4", "offset_z offset_variance"),
    *_of("f8", "low high"),
)
#: Of recordings from before a map told bounds.
CELL_FIELDS_BEFORE = CELL_FIELDS[:-2]

#: Values of ``map/observed``: mapped, seen but not yet mapped, no point fell there.
KNOWN, SEEN, NOT_SEEN = 100, 50, -1

#: Fields of a ``landing/site_table`` point.
SITE_FIELDS = (
    *_of("f4", "x y z score slope roughness hazard_distance subscale_height"),
    *_of("u4", "id answer"),
    *_of("f4", "probability"),
)

#: Fields of the one ``landing/status`` point.
STATUS_FIELDS = (
    *_of("f4", "x y z hazard_distance age offset_z offset_variance"),
    *_of("u4", "id answer"),
    *_of("u1", "reason state"),
    *_of("f4", "seen probability"),
    *_of("u1", "doubts"),
    *_of("f4", "now_x now_y now_z now_probability gain wait"),
)
#: ... and with a prior: how far the map lies from it, and the covariance of that.
_OF_PRIOR = _of("f4", tuple(f"prior_{of}" for of in "x y z xx xy xz yy yz zz".split()))
PRIOR_STATUS_FIELDS = (*STATUS_FIELDS, *_OF_PRIOR)


def record_dtype(fields: tuple[tuple[str, str], ...]) -> np.dtype[np.void]:
    """Packed little-endian record type of a table of fields."""
    return np.dtype([(name, "<" + kind) for name, kind in fields])


def encode_cells(cells: CellMap) -> NDArray[np.void]:
    """One record per leaf, (M,) of ``record_dtype(CELL_FIELDS)``."""
    out = np.zeros(len(cells.level), dtype=record_dtype(CELL_FIELDS))
    out["x"], out["y"], out["size"] = cells.x, cells.y, cells.size
    out["z"] = bounded(cells.z, cells.low, cells.high)
    out["elevation"] = cells.z
    for axis, name in enumerate(_NORMAL):
        out[name] = cells.normal[:, axis]
    for names, matrix in ((_RANGE, cells.covariance_range), (_POSE, cells.covariance_pose)):
        for name, (i, j) in zip(names, _UPPER, strict=True):
            out[name] = matrix[:, i, j]
    out["roughness"], out["exception_fraction"] = cells.roughness, cells.exception_fraction
    for column, name in enumerate(_FEATURE):
        out[name] = cells.feature[:, column]
    out["count"], out["ix"], out["iy"] = cells.count, cells.ix, cells.iy
    out["level"], out["min_level"] = cells.level, cells.domain.min_level
    out["measured"] = cells.measured
    out["offset_z"], out["offset_variance"] = cells.offset_z, cells.offset_variance
    out["low"], out["high"] = cells.low, cells.high
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
        records: (M,) of ``record_dtype(CELL_FIELDS)``, or without the bounds.
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
    max_level = n.bit_length() - 1
    if max_level > MOST_LEVELS or len(records) > MOST_LEAVES:
        msg = (
            f"map of {len(records)} leaves on {n} x {n} finest cells: {MOST_LEAVES} leaves and"
            f" {1 << MOST_LEVELS} cells a side are the most"
        )
        raise MessageError("too_large", msg)
    level = np.ascontiguousarray(records["level"])
    ix, iy = records["ix"].astype(np.uint32), records["iy"].astype(np.uint32)
    beyond = (level > max_level) | (np.maximum(ix, iy) >> np.minimum(level, 31) > 0)
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
    raster = np.full((n, n), -1, dtype=np.int32)
    leaf_raster(level, ix, iy, raster)
    if (raster < 0).any():
        msg = "map/cells has leaves that overlap"
        raise MessageError("tiling", msg)
    measured, unbounded = records["measured"] > 0, np.full(len(records), np.nan)
    low, high = (
        records[name].astype(np.float64) if name in (records.dtype.names or ()) else unbounded
        for name in ("low", "high")
    )
    elevation = records["elevation"].astype(np.float64)
    # A map from before does not say what its inherited planes are known for.
    before = known is None or "low" not in (records.dtype.names or ())
    of_plane = measured if before else np.isfinite(elevation)
    cells = CellMap(
        stamp_ns=stamp_ns,
        domain=domain,
        level=level,
        ix=ix,
        iy=iy,
        z=elevation,
        normal=_columns(records, _NORMAL),
        covariance_range=_matrices(records, _RANGE),
        covariance_pose=_matrices(records, _POSE),
        count=records["count"].astype(np.uint32),
        measured=measured,
        roughness=records["roughness"].astype(np.float64),
        exception_fraction=records["exception_fraction"].astype(np.float64),
        feature=_columns(records, _FEATURE),
        low=low,
        high=high,
        observed=observed,
        known=observed & of_plane[raster] & (True if known is None else known),
        offset_z=float(records["offset_z"][0]),
        offset_variance=float(records["offset_variance"][0]),
    )
    _check(cells)
    return cells


def _check(cells: CellMap) -> None:
    """Refuse estimates that none can be. Raises `MessageError`: reason ``values``."""
    known = cells.estimated
    parts = cells.covariance_range, cells.covariance_pose
    sound = sound_planes(cells.z, cells.normal, parts, cells.feature)
    sound &= ~cells.measured | ((cells.roughness >= 0.0) & (cells.roughness < MOST))
    off = (cells.offset_z, cells.offset_variance)
    sound_offset = np.isnan(off).all() or (abs(off[0]) < MOST_HEIGHT and 0.0 <= off[1] < MOST)
    if not sound_offset:
        msg = f"map/cells has an impossible offset: {off[0]} m of variance {off[1]}"
        raise MessageError("values", msg)
    if not sound[known].all() or cells.measured[~known].any():
        msg = "map/cells has a leaf with an impossible plane (normal, elevation, covariance)"
        raise MessageError("values", msg)
    bounds = np.stack([cells.low, cells.high])
    if (np.abs(bounds) >= MOST_HEIGHT).any() or (cells.low > cells.high).any():
        msg = "map/cells has a leaf with impossible bounds (low, high)"
        raise MessageError("values", msg)


def _columns(records: NDArray[np.void], names: tuple[str, ...]) -> Array:
    return np.stack([records[name].astype(np.float64) for name in names], axis=-1)


def _matrices(records: NDArray[np.void], names: tuple[str, ...]) -> Array:
    out = np.empty((len(records), 3, 3))
    for name, (i, j) in zip(names, _UPPER, strict=True):
        out[:, i, j] = out[:, j, i] = records[name]
    return out


def round_trip(cells: CellMap) -> CellMap:
    """The map as a subscriber gets it: some columns in single precision."""

    def single(values: Array) -> Array:
        return values.astype(np.float32).astype(np.float64)

    return replace(
        cells,
        covariance_range=single(cells.covariance_range),
        covariance_pose=single(cells.covariance_pose),
        roughness=single(cells.roughness),
        exception_fraction=single(cells.exception_fraction),
        feature=single(cells.feature),
        offset_z=float(np.float32(cells.offset_z)),
        offset_variance=float(np.float32(cells.offset_variance)),
    )


def encode_sites(assessment: LandingAssessment) -> NDArray[np.void]:
    """One record per ranked site, (K,) of ``record_dtype(SITE_FIELDS)``, best first."""
    sites = assessment.sites
    out = np.zeros(len(sites.score), dtype=record_dtype(SITE_FIELDS))
    for axis, name in enumerate("xyz"):
        out[name] = sites.position[:, axis]
    out["score"], out["slope"] = sites.score, np.radians(sites.slope_deg)
    out["roughness"], out["hazard_distance"] = sites.roughness, sites.hazard_distance
    out["subscale_height"] = sites.subscale_height
    out["id"], out["answer"] = sites.id, assessment.number
    out["probability"] = sites.probability
    return out


def encode_status(
    assessment: LandingAssessment, age: float, prior: Array | None = None
) -> tuple[NDArray[np.void], tuple[tuple[str, str], ...]]:
    """The one record (1,) and its fields. ``assessment``: the answer. ``age``: of its map when it
    is sent, s; NaN if unknown. ``prior``: (9,) of `prior_from_message`, None without."""
    selected = assessment.selected
    fields = STATUS_FIELDS if prior is None else PRIOR_STATUS_FIELDS
    out = np.zeros(1, dtype=record_dtype(fields))
    if prior is not None:
        for (name, _), value in zip(_OF_PRIOR, prior, strict=True):
            out[name] = value
    for axis, name in enumerate("xyz"):
        out[name] = selected.position[axis]
    out["hazard_distance"] = selected.site.hazard_distance if selected.id else np.nan
    out["age"] = age
    out["offset_z"], out["offset_variance"] = assessment.offset_z, assessment.offset_variance
    out["id"], out["answer"], out["reason"] = selected.id, assessment.number, selected.reason
    out["state"], out["seen"] = selected.state, assessment.seen
    out["probability"], out["doubts"] = selected.probability, len(assessment.doubts)
    names = ("now_x", "now_y", "now_z", "now_probability")
    for name, value in zip(names, assessment.now, strict=True):
        out[name] = value
    out["gain"], out["wait"] = assessment.gain, WAIT_S
    return out, fields


def encode_observed(observed: Mask, known: Mask) -> NDArray[np.int8]:
    """OccupancyGrid values of ``map/observed``: 100 mapped, 50 seen, not yet mapped, -1 unseen."""
    out = np.where(observed, np.int8(SEEN), np.int8(NOT_SEEN))
    out[observed & known] = KNOWN
    return out


def decode_observed(values: NDArray[np.int8]) -> tuple[Mask, Mask]:
    """Where a point fell, and where it may be part of the map; recordings from before told both
    alike."""
    return values > 0, values > SEEN


_HAZARD_VALUES = np.tile(np.array([0, *[100] * 0x3F], dtype=np.int8), 4)
_HAZARD_VALUES[0x40::0x40] = -1
"""Of ``landing/hazards`` by the bits of a grid point; 0x80 alone is unseen ground, with 0x40 ground
that is seen but not yet mapped."""


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
