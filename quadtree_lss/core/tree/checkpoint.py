# SPDX-License-Identifier: Apache-2.0
"""A mapper's state as bytes and back, checked before it replaces anything.

The bytes are an ``npz`` archive, in which each array has a checksum: what was cut short or
damaged is refused. Reading and writing files is the caller's.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core.mapping.mapper import Mapper
from quadtree_lss.core.tree.quadtree import Domain, fill_blocks
from quadtree_lss.errors import QuadtreeLssError

FORMAT = 2
"""Goes up whenever the arrays of `Mapper.export_state` change their meaning."""

State: TypeAlias = dict[str, NDArray[Any]]


class CheckpointError(QuadtreeLssError):
    """The bytes are no checkpoint, or not one of this mapper's domain."""


def export_checkpoint(mapper: Mapper) -> State:
    """The mapper's state with what identifies it; copies, so that the mapper may go on."""
    return {
        "format": np.array(FORMAT),
        "domain": _identity(mapper.domain),
        **mapper.export_state(),
    }


def to_bytes(state: State) -> bytes:
    """The archive of `export_checkpoint`'s arrays."""
    out = io.BytesIO()
    np.savez(out, **state)  # type: ignore[arg-type]
    return out.getvalue()


def from_bytes(content: bytes) -> State:
    """Arrays of an archive.

    Raises:
        CheckpointError: damaged, cut short or something else.
    """
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except Exception as error:  # zipfile and NumPy raise a dozen kinds on damaged bytes
        msg = f"is no checkpoint, or a damaged one ({type(error).__name__})"
        raise CheckpointError(msg) from None


def restore(mapper: Mapper, state: State) -> None:
    """Put the mapper into a state; it goes on exactly as the one that was exported.

    Raises:
        CheckpointError: another format or domain, arrays missing or inconsistent; the mapper is
            then unchanged.
    """
    wanted, found = _identity(mapper.domain), state.get("domain", np.empty(0))
    alike = found.dtype == wanted.dtype and found.shape == wanted.shape
    if not alike or not np.array_equal(state.get("format", ""), FORMAT):
        msg = "is no checkpoint of this version"
        raise CheckpointError(msg)
    if not np.array_equal(found, wanted):
        msg = (
            f"is of another domain: xmin, ymin, size, min_level, max_level are"
            f" {_listed(found)}, here {_listed(wanted)}"
        )
        raise CheckpointError(msg)
    _check_arrays(mapper.export_state(), state)
    _check_leaves(mapper, state)
    _check_stored(state)
    _check_alignment(state)
    mapper.import_state({k: v for k, v in state.items() if k not in ("format", "domain")})


def _identity(domain: Domain) -> NDArray[np.float64]:
    numbers = (domain.xmin, domain.ymin, domain.size, domain.min_level, domain.max_level)
    return np.array(numbers, dtype=np.float64)


def _listed(values: NDArray[Any]) -> str:
    return ", ".join(f"{value:g}" for value in values)


def _check_arrays(like: Mapping[str, NDArray[Any]], state: State) -> None:
    """Names, types and shapes beyond the first axis are those of a state of this program."""
    missing = sorted(set(like) - set(state))
    if missing:
        msg = f"lacks {missing[0]}"
        raise CheckpointError(msg)
    for name, example in like.items():
        found = state[name]
        fits = found.dtype == example.dtype and found.ndim == example.ndim
        if not fits or (name != "stored.points" and found.shape[1:] != example.shape[1:]):
            msg = f"holds {name} as {found.dtype} of shape {found.shape}"
            raise CheckpointError(msg)


def _check_leaves(mapper: Mapper, state: State) -> None:
    domain = mapper.domain
    level, ix, iy = (state[f"leaves.{name}"] for name in ("level", "ix", "iy"))
    count = len(level)
    if any(len(v) != count for k, v in state.items() if k.startswith("leaves.")):
        msg = "has columns of different lengths"
        raise CheckpointError(msg)
    if count > mapper.leaves.max_cells:
        msg = f"has {count} leaves, mapping.max_cells is {mapper.leaves.max_cells}"
        raise CheckpointError(msg)
    sound = (level >= domain.min_level) & (level <= domain.max_level) & (np.minimum(ix, iy) >= 0)
    sound &= np.maximum(ix, iy) >> np.minimum(level, 31) == 0
    raster = np.full(domain.finest_count**2, -1, dtype=np.int32)
    if sound.all():
        fill_blocks(raster, domain, level, ix, iy, np.arange(count, dtype=np.int32))
    if np.sum(0.25 ** level.astype(np.float64)) != 1.0 or (raster < 0).any():
        msg = "has leaves that do not tile the domain"
        raise CheckpointError(msg)
    if len(state["observed"]) != domain.finest_count**2:
        msg = "has an observed mask of another size"
        raise CheckpointError(msg)
    z, normal = state["leaves.z"], state["leaves.normal"]
    known = np.isfinite(z)
    whole = np.isfinite(normal[known]).all() and (normal[known, 2] > 0.0).all()
    whole &= np.isfinite(state["leaves.parts"][known]).all()
    if not whole or state["leaves.measured"][~known].any():
        msg = "has a leaf with an impossible plane"
        raise CheckpointError(msg)


def _check_stored(state: State) -> None:
    row, scan, keys = state["stored.row"], state["stored.scan"], state["stored.keys"]
    points = state["stored.points"]
    inside = not len(row) or (row.min() >= 0 and row.max() < len(state["leaves.level"]))
    lengths = {len(scan), points.shape[1]} == {len(row)} and points.shape[0] == 3
    posed = {len(state["stored.positions"]), len(state["stored.roots"])} == {len(keys)}
    known = np.isin(scan, keys).all() and (not len(keys) or keys.max() < state["stored.next_scan"])
    if not (inside and lengths and posed and known):
        msg = "has stored points without a leaf or a scan"
        raise CheckpointError(msg)
    if not all(np.isfinite(state[f"stored.{n}"]).all() for n in ("points", "positions", "roots")):
        msg = "has a stored point that is not finite"
        raise CheckpointError(msg)


def _check_alignment(state: State) -> None:
    mean, covariance = state["alignment.mean"], state["alignment.covariance"]
    whole = mean.shape == (6,) and covariance.shape == (6, 6) and bool(np.isfinite(mean).all())
    # NaN until the first scan.
    if whole and not np.isnan(covariance).all():
        whole = bool(np.isfinite(covariance).all() and (np.diag(covariance) >= 0.0).all())
    if not (whole and 0.0 < float(state["alignment.persistence"]) < 1.0):
        msg = "has an impossible alignment of scans"
        raise CheckpointError(msg)
