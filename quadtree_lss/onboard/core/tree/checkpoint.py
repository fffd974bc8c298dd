# SPDX-License-Identifier: Apache-2.0
"""A mapper's state as bytes and back, checked before it replaces anything.

The bytes are an ``npz`` archive, in which each array has a checksum: what was cut short or
damaged is refused. Reading and writing files is the caller's.
"""

from __future__ import annotations

import io
import math
import zipfile
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.core.geometry.bounds import MOST, MOST_HEIGHT
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.core.tree.held_returns import SHOWN
from quadtree_lss.onboard.core.tree.leaves import LEAF, MEASURED, OUT, leaf_raster
from quadtree_lss.onboard.core.tree.soundness import sound_planes
from quadtree_lss.onboard.errors import QuadtreeLssError

FORMAT = 8
"""Goes up whenever the arrays of `Mapper.export_state` change their meaning."""

ROUNDING = 1e-6
"""By how much a share may be off by rounding."""
CORRELATION_ROUNDING = 0.05
"""And the square of a correlation: poses may claim 10^18 times what range noise does, and what both
told is fused as one (`geometry.plane.keep_possible`)."""
SURE = 1e-12
"""Variance that rounding leaves (`geometry.plane`), rad^2 and m^2."""

MOST_NS = 2**31 * 10**9
"""Stamps of messages end there."""
MOST_OWED = 1.0
"""The map is lifted by more than a sixth of this at once, m (`mapping.alignment.LEAST_LIFT` of the
highest vehicle)."""
MOST_TURN = 1e6
"""What noise may turn and lift a fit by (`LEAF`), rad and m."""
NEVER_NEGATIVE = frozenset(
    "points distance_sum noise_sum exception_sum exception_noise residuals division_sum"
    " division_weight square_sum greatest strip uneven".split()
)

State: TypeAlias = dict[str, NDArray[Any]]


class CheckpointError(QuadtreeLssError):
    """The bytes are no checkpoint, or not one of this mapper's domain."""


def to_bytes(state: State) -> bytes:
    """The archive of a state's arrays."""
    out = io.BytesIO()
    np.savez(out, **state)  # type: ignore[arg-type]
    return out.getvalue()


def from_bytes(content: bytes) -> State:
    """Arrays of an archive. Raises `CheckpointError`: damaged, cut short or something else."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            _check_sizes(archive, len(content))
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except CheckpointError:
        raise
    except Exception as error:  # zipfile and NumPy raise a dozen kinds on damaged bytes
        msg = f"is not a checkpoint, or a damaged one ({type(error).__name__})"
        raise CheckpointError(msg) from None


def _see(sound: bool | np.bool_, otherwise: str) -> None:
    """Raises `CheckpointError`, with this line, unless something is sound."""
    if not sound:
        raise CheckpointError(otherwise)


def _check_sizes(archive: zipfile.ZipFile, size: int) -> None:
    """See that an archive of ``size`` bytes unpacks to no more than these. Raises
    `CheckpointError`: something in it is compressed, or it claims more than there is."""
    parts = archive.infolist()
    stored = all(part.compress_type == zipfile.ZIP_STORED for part in parts)
    stored &= sum(part.file_size for part in parts) <= size
    _see(stored, "is not a checkpoint: its content is compressed or larger than itself")


def identified(state: State, domain: Domain) -> State:
    """A state with the version and the domain that it is of."""
    return {"format": np.array(FORMAT), "domain": _identity(domain), **state}


def check(
    state: State, like: State, domain: Domain, max_cells: int, *, follows: bool = False
) -> Domain:
    """See that a mapper of this domain can go on from a state from outside; the domain of that.
    ``like`` is an `identified` state of such a mapper, for the names, types and shapes of its
    arrays. With ``follows`` the domain may be another one moved by whole coarsest cells. Raises
    `CheckpointError`: another format or domain, too many leaves, arrays missing or inconsistent."""
    wanted, found = like["domain"], state.get("domain", np.empty(0))
    alike = found.dtype == wanted.dtype and found.shape == wanted.shape
    alike &= np.array_equal(state.get("format", ""), FORMAT)
    _see(alike, "is not a checkpoint of this version")
    xmin, ymin, *_ = found.tolist()
    there = replace(domain, xmin=xmin, ymin=ymin)
    off = domain.cells_to(there) if follows and np.isfinite(found).all() else None
    whole = 1 << (domain.max_level - domain.min_level)
    moved = off is not None and not any(cells % whole for cells in off)
    same = np.array_equal(found, wanted) or (moved and np.array_equal(found[2:], wanted[2:]))
    listed = f"{_listed(found)}, here {_listed(wanted)}"
    _see(same, f"is of another domain: xmin, ymin, size, min_level, max_level are {listed}")
    for name, example in like.items():
        _see(name in state, f"lacks {name}")
        array, any_number = state[name], 1 if name == "leaves" else 0
        alike = array.dtype == example.dtype and array.ndim == example.ndim
        _see(alike, f"holds {name} as {array.dtype} of {array.ndim} dimensions")
        alike = array.shape[any_number:] == example.shape[any_number:]
        _see(alike, f"holds {name} of shape {array.shape}")
    count = len(state["leaves"])
    _see(count <= max_cells, f"has {count} leaves, mapping.max_cells is {max_cells}")
    _check_leaves(state["leaves"], domain)
    _see((state["observed"] <= OUT).all(), "has an impossible mask of observed cells")
    rises, returns = state["piled"].T
    possible = (np.abs(rises) < MOST) & (returns >= 0.0) & (returns < MOST)
    _see(possible.all(), "has finest cells with impossible returns")
    held, scans = state["held_scan"], int(state["held_scans"])
    possible = (np.abs(state["held_height"]) < MOST_HEIGHT) & (held >= 0) & (held <= scans)
    possible &= state["held_shown"] <= SHOWN
    sound = bool(possible.all()) and scans < 2**31
    sound &= abs(float(state["held_lifted"])) < MOST_HEIGHT
    _see(sound, "has impossible held-back returns")
    height, variance = state["offset"].tolist()
    none = math.isnan(height) and math.isnan(variance)
    known = abs(height) < MOST_HEIGHT and 0.0 <= variance < MOST
    _see(none or known, "has an impossible offset from navigation")
    refused, height, variance = state["against"].tolist()
    sound = abs(height) < 2.0 * MOST_HEIGHT  # of one place over another
    sound &= 0.0 <= variance < MOST and 0.0 <= refused < MOST
    sound &= abs(float(state["owed"])) < MOST_OWED
    sound &= all(0 <= int(state[name]) < MOST_NS for name in ("stamp_ns", "start_ns"))
    ratio = float(state["noise_ratio"])
    sound &= math.isnan(ratio) or 0.0 <= ratio < MOST
    _see(sound, "has impossible times, heights or ratios")
    return there


def _check_leaves(leaves: NDArray[Any], domain: Domain) -> None:
    level, ix, iy = (leaves[name] for name in ("level", "ix", "iy"))
    sound = (level >= domain.min_level) & (level <= domain.max_level) & (np.minimum(ix, iy) >= 0)
    sound &= np.maximum(ix, iy) >> np.clip(level, 0, 31) == 0
    raster = np.full((domain.finest_count,) * 2, -1, dtype=np.int32)
    if sound.all():
        leaf_raster(level.astype(np.uint8), ix.astype(np.uint32), iy.astype(np.uint32), raster)
    tiled = sound.all() and np.sum(0.25 ** level.astype(np.float64)) == 1.0
    _see(tiled and (raster >= 0).all(), "has leaves that do not tile the domain")
    known = leaves["known"]
    planes = leaves[known > 0]
    of_plane = (planes[name] for name in ("z", "normal", "range_part", "pose_part", "feature"))
    whole = ((known >= 0) & (known <= MEASURED)).all()
    whole &= sound_planes(*of_plane).all()
    for name in LEAF.names or ():
        if LEAF[name].base.kind == "f" and name not in {"low", "high", "feature"}:
            most = MOST**2 if name == "feature_information" else MOST
            whole &= (np.abs(leaves[name]) < most).all()
        if name in NEVER_NEGATIVE:
            whole &= (leaves[name] >= 0.0).all()
    whole &= (leaves["exception_sum"] <= leaves["residuals"] * (1.0 + ROUNDING)).all()
    xx, xy, yy, rise, weight = leaves["bias"].T
    with np.errstate(over="ignore", invalid="ignore"):
        whole &= ((xx + yy < MOST_TURN**2) & (np.abs(rise) < MOST_TURN) & (weight >= 0.0)).all()
        whole &= ((xx >= 0.0) & (yy >= 0.0) & (xy * xy <= xx * yy * (1.0 + ROUNDING))).all()
    whole &= (leaves["points"] < 2**32).all()
    low, high = leaves["low"], leaves["high"]
    # Where nothing came to rest yet they are infinity and minus infinity.
    within = (low > -MOST_HEIGHT) & (high < MOST_HEIGHT)
    whole &= (within & ((low > high) | (low < MOST_HEIGHT) & (high > -MOST_HEIGHT))).all()
    whole &= not (planes["range_part"][:, ::4] <= 0.0).any()
    _see(whole and _covariances(planes), "has a leaf with an impossible plane")


def _covariances(planes: NDArray[Any]) -> bool:
    """True if the covariances of finite planes are symmetric and positive semi-definite.

    Judged as correlations, so that a large variance does not hide what a small one lacks.
    """
    for name in ("range_part", "pose_part"):
        covariance = planes[name].reshape(-1, 3, 3)
        deviation = np.sqrt(covariance.diagonal(axis1=1, axis2=2) + SURE)
        correlation = covariance / (deviation[:, :, None] * deviation[:, None, :])
        # No principal minor is negative, nor NaN.
        a, b, c = correlation[:, 0, 1], correlation[:, 0, 2], correlation[:, 1, 2]
        minors = [1.0 - a * a, 1.0 - b * b, 1.0 - c * c]
        minors.append(minors[0] - b * b - c * c + 2.0 * a * b * c)
        skew = np.abs(correlation - correlation.transpose(0, 2, 1))
        if not all((minor >= -CORRELATION_ROUNDING).all() for minor in [*minors, -skew]):
            return False
    return True


def _identity(domain: Domain) -> NDArray[np.float64]:
    numbers = (domain.xmin, domain.ymin, domain.size, domain.min_level, domain.max_level)
    return np.array(numbers, dtype=np.float64)


def _listed(values: NDArray[Any]) -> str:
    return ", ".join(f"{value:g}" for value in values)
