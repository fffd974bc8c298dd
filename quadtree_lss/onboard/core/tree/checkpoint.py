# SPDX-License-Identifier: Apache-2.0
"""A mapper's state as an ``npz`` archive, which has a checksum for each array, and its check."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import Any, BinaryIO, TypeAlias

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.core.tree.columns import sound_planes
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.core.tree.leaves import ESTIMATED, LEAF, leaf_raster
from quadtree_lss.onboard.errors import QuadtreeLssError

#: Increases whenever the arrays of `Mapper.export_state` change their meaning.
FORMAT = 11

#: Tolerance of a principal minor of a correlation matrix. Fusion leaves this much when the pose
#: variance is up to 10^18 times the range variance.
CORRELATION_ROUNDING = 0.05
#: Variance that rounding leaves in `geometry.plane`, rad^2 and m^2.
ROUNDING_VARIANCE = 1e-12

State: TypeAlias = dict[str, NDArray[Any]]


class CheckpointError(QuadtreeLssError):
    """The bytes are not a checkpoint, or not one of this mapper's domain."""


def to_bytes(state: State) -> bytes:
    """Write the arrays of a state to an archive."""
    out = io.BytesIO()
    np.savez(out, **state)  # type: ignore[arg-type]
    return out.getvalue()


def from_file(file: BinaryIO) -> State:
    """Read the arrays of an open archive. Raises `CheckpointError`: damaged or another format."""
    try:
        with np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except Exception as error:  # zipfile and NumPy raise a dozen kinds on damaged bytes
        msg = f"is not a checkpoint, or is damaged ({type(error).__name__})"
        raise CheckpointError(msg) from None


def _require(condition: bool | np.bool_, otherwise: str) -> None:
    if not condition:
        raise CheckpointError(otherwise)


def check(
    state: State, like: State, domain: Domain, max_cells: int, *, follows: bool = False
) -> Domain:
    """Check that a mapper of this domain can continue from a state; return the state's domain.

    ``like``: a state of such a mapper. ``follows``: the domain may be moved by whole
    coarsest cells. Raises `CheckpointError`: another format or domain, too many leaves, missing or
    inconsistent arrays, implausible planes.
    """
    wanted, found = like["domain"], state.get("domain", np.empty(0))
    alike = found.dtype == wanted.dtype and found.shape == wanted.shape
    alike &= np.array_equal(state.get("format", ""), FORMAT)
    _require(alike, "is not a checkpoint of this version")
    xmin, ymin, *_ = found.tolist()
    there = replace(domain, xmin=xmin, ymin=ymin)
    off = domain.cells_to(there) if follows and np.isfinite(found).all() else None
    whole = 1 << (domain.max_level - domain.min_level)
    moved = off is not None and not any(cells % whole for cells in off)
    same = np.array_equal(found, wanted) or (moved and np.array_equal(found[2:], wanted[2:]))
    listed = f"{found.tolist()}, here {wanted.tolist()}"
    _require(same, f"is of another domain: xmin, ymin, size, min_level, max_level are {listed}")
    for name, example in like.items():
        array, any_number = state.get(name, np.empty(0)), 1 if name == "leaves" else 0
        alike = array.dtype == example.dtype and array.ndim == example.ndim
        alike = alike and array.shape[any_number:] == example.shape[any_number:]
        _require(alike, f"has no {name} of the type and shape of {example.dtype}{example.shape}")
    count = len(state["leaves"])
    _require(count <= max_cells, f"has {count} leaves, mapping.max_cells is {max_cells}")
    _check_leaves(state["leaves"], domain)
    return there


def _check_leaves(leaves: NDArray[Any], domain: Domain) -> None:
    level, ix, iy = (leaves[name] for name in ("level", "ix", "iy"))
    sound = (level >= domain.min_level) & (level <= domain.max_level) & (np.minimum(ix, iy) >= 0)
    sound &= np.maximum(ix, iy) >> np.clip(level, 0, 31) == 0
    raster = np.full((domain.finest_count,) * 2, -1, dtype=np.int32)
    if sound.all():
        leaf_raster(level.astype(np.uint8), ix.astype(np.uint32), iy.astype(np.uint32), raster)
    tiled = sound.all() and np.sum(0.25 ** level.astype(np.float64)) == 1.0
    _require(tiled and (raster >= 0).all(), "has leaves that do not tile the domain")
    known = leaves["state"]
    possible = ((known >= 0) & (known <= ESTIMATED)).all()
    for name in LEAF.names or ():
        if LEAF[name].base.kind == "f" and name not in {"low", "high", "feature"}:
            possible &= np.isfinite(leaves[name]).all()
    planes = leaves[known > 0]
    parts = [planes[name].reshape(-1, 3, 3) for name in ("range_part", "pose_part")]
    possible &= sound_planes(planes["z"], planes["normal"], *parts, planes["feature"]).all()
    _require(possible and all(map(_are_covariances, parts)), "has a leaf with an impossible plane")


def _are_covariances(matrices: NDArray[np.float64]) -> bool:
    """Return whether finite matrices (M, 3, 3) are symmetric and positive semidefinite.

    Correlations are compared, so that a large variance does not hide a wrong small one.
    """
    sigma = np.sqrt(matrices.diagonal(axis1=1, axis2=2) + ROUNDING_VARIANCE)
    correlation = matrices / (sigma[:, :, None] * sigma[:, None, :])
    asymmetry = np.abs(correlation - correlation.transpose(0, 2, 1))
    least = min(np.linalg.eigvalsh(correlation).min(initial=0.0), -asymmetry.max(initial=0.0))
    return bool(least >= -CORRELATION_ROUNDING)
