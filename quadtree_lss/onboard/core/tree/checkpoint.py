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
from quadtree_lss.onboard.core.tree.leaves import LEAF, MEASURED, OUT, leaf_raster
from quadtree_lss.onboard.core.tree.soundness import sound_planes
from quadtree_lss.onboard.errors import QuadtreeLssError

FORMAT = 7
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


def _check_sizes(archive: zipfile.ZipFile, size: int) -> None:
    """See that an archive of ``size`` bytes unpacks to no more than these. Raises
    `CheckpointError`: something in it is compressed, or it claims more than there is."""
    parts = archive.infolist()
    packed = any(part.compress_type != zipfile.ZIP_STORED for part in parts)
    if packed or sum(part.file_size for part in parts) > size:
        msg = "is not a checkpoint: its content is compressed or larger than itself"
        raise CheckpointError(msg)


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
    if not alike or not np.array_equal(state.get("format", ""), FORMAT):
        msg = "is not a checkpoint of this version"
        raise CheckpointError(msg)
    xmin, ymin, *_ = found.tolist()
    there = replace(domain, xmin=xmin, ymin=ymin)
    off = domain.cells_to(there) if follows and np.isfinite(found).all() else None
    whole = 1 << (domain.max_level - domain.min_level)
    moved = off is not None and not any(cells % whole for cells in off)
    if not np.array_equal(found, wanted) and not (moved and np.array_equal(found[2:], wanted[2:])):
        msg = (
            f"is of another domain: xmin, ymin, size, min_level, max_level are"
            f" {_listed(found)}, here {_listed(wanted)}"
        )
        raise CheckpointError(msg)
    for name, example in like.items():
        if name not in state:
            msg = f"lacks {name}"
            raise CheckpointError(msg)
        array = state[name]
        shape = array.shape[1:] if name == "leaves" else array.shape
        if array.dtype != example.dtype or array.ndim != example.ndim:
            msg = f"holds {name} as {array.dtype} of {array.ndim} dimensions"
            raise CheckpointError(msg)
        if shape != (example.shape[1:] if name == "leaves" else example.shape):
            msg = f"holds {name} of shape {array.shape}"
            raise CheckpointError(msg)
    if len(state["leaves"]) > max_cells:
        msg = f"has {len(state['leaves'])} leaves, mapping.max_cells is {max_cells}"
        raise CheckpointError(msg)
    _check_leaves(state["leaves"], domain)
    if (state["observed"] > OUT).any():
        msg = "has an impossible mask of observed cells"
        raise CheckpointError(msg)
    rises, returns = state["piled"].T
    if not ((np.abs(rises) < MOST) & (returns >= 0.0) & (returns < MOST)).all():
        msg = "has finest cells with impossible returns"
        raise CheckpointError(msg)
    height, variance = state["offset"].tolist()
    none = math.isnan(height) and math.isnan(variance)
    if not none and not (abs(height) < MOST_HEIGHT and 0.0 <= variance < MOST):
        msg = "has an impossible offset from navigation"
        raise CheckpointError(msg)
    refused, height, variance = state["against"].tolist()
    sound = abs(height) < 2.0 * MOST_HEIGHT  # of one place over another
    sound &= 0.0 <= variance < MOST and 0.0 <= refused < MOST
    sound &= abs(float(state["owed"])) < MOST_OWED
    sound &= all(0 <= int(state[name]) < MOST_NS for name in ("stamp_ns", "start_ns"))
    ratio = float(state["noise_ratio"])
    if not sound or not (math.isnan(ratio) or 0.0 <= ratio < MOST):
        msg = "has impossible times, heights or ratios"
        raise CheckpointError(msg)
    return there


def _check_leaves(leaves: NDArray[Any], domain: Domain) -> None:
    level, ix, iy = (leaves[name] for name in ("level", "ix", "iy"))
    sound = (level >= domain.min_level) & (level <= domain.max_level) & (np.minimum(ix, iy) >= 0)
    sound &= np.maximum(ix, iy) >> np.clip(level, 0, 31) == 0
    raster = np.full((domain.finest_count,) * 2, -1, dtype=np.int32)
    if sound.all():
        leaf_raster(level.astype(np.uint8), ix.astype(np.uint32), iy.astype(np.uint32), raster)
    tiled = sound.all() and np.sum(0.25 ** level.astype(np.float64)) == 1.0
    if not tiled or (raster < 0).any():
        msg = "has leaves that do not tile the domain"
        raise CheckpointError(msg)
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
    if not whole or (planes["range_part"][:, ::4] <= 0.0).any() or not _covariances(planes):
        msg = "has a leaf with an impossible plane"
        raise CheckpointError(msg)


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
