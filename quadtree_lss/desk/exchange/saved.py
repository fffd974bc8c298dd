# SPDX-License-Identifier: Apache-2.0
"""Files of a results folder: a map as the arrays of ``cells.npz``, and back; tables read back."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.errors import QuadtreeLssError

Table = dict[str, NDArray[Any]]
"""Columns of a CSV file by name: whole numbers, numbers, or else texts."""
SAME = ("level", "ix", "iy", "z", "covariance_pose", "count", "measured", "roughness")
SAME += ("exception_fraction", "feature", "low", "high")
"""Arrays of ``cells.npz`` that are the columns of a map of that name."""
NEEDED = (*SAME, "nx", "ny", "nz", "covariance")
MASKS = ("observed_cells", "known_cells")
NEEDED_ELSE = (*MASKS, "domain", "stamp_ns", "offset")


class ResultsError(QuadtreeLssError):
    """A folder is none that a replay wrote, or one of its files cannot be read."""


def cells_arrays(cells: CellMap) -> dict[str, NDArray[Any]]:
    """Content of ``cells.npz``: one array per field of the leaves, in Morton order."""
    domain = cells.domain
    of_domain = [domain.xmin, domain.ymin, domain.size, domain.min_level, domain.max_level]
    return {
        **{name: getattr(cells, name) for name in (*SAME, "x", "y", "size", "covariance")},
        **{f"n{axis}": cells.normal[:, k] for k, axis in enumerate("xyz")},
        "observed": np.bincount(cells.leaf_raster()[cells.observed], minlength=len(cells.z)),
        "observed_cells": cells.observed,
        "known_cells": cells.known,
        "domain": np.array(of_domain),
        "stamp_ns": np.array(cells.stamp_ns),
        "offset": np.array([cells.offset_z, cells.offset_variance]),
    }


def cell_map(path: str | Path, a: Mapping[str, NDArray[Any]]) -> CellMap:
    """The map in the arrays of ``cells.npz``. Raises `ResultsError`: they are none."""
    missing = [name for name in (*NEEDED, *NEEDED_ELSE) if name not in a]
    if missing:
        raise unreadable(path, f"it lacks {', '.join(missing)}: replay the bag again")
    if a["domain"].shape != (5,):
        raise unreadable(path, "domain has another size than 5")
    xmin, ymin, size, low, high = a["domain"].tolist()
    domain = Domain(xmin, ymin, size, int(low), int(high))
    leaves, sides = len(a["level"]), (domain.finest_count,) * 2
    wrong = [name for name in NEEDED if len(a[name]) != leaves]
    wrong += [name for name in MASKS if a[name].shape != sides]
    if wrong:
        raise unreadable(path, f"{wrong[0]} has another size than the map")
    kinds = {"level": np.uint8, "ix": np.uint32, "iy": np.uint32, "count": np.uint32}
    kinds["measured"] = np.bool_
    columns = {name: a[name].astype(kinds.get(name, a[name].dtype)) for name in SAME}
    return CellMap(
        **columns,
        stamp_ns=int(a["stamp_ns"]),
        domain=domain,
        normal=np.column_stack([a["nx"], a["ny"], a["nz"]]),
        covariance_range=a["covariance"] - a["covariance_pose"],
        observed=a["observed_cells"].astype(np.bool_),
        known=a["known_cells"].astype(np.bool_),
        offset_z=float(a["offset"][0]),
        offset_variance=float(a["offset"][1]),
    )


def unreadable(path: str | Path, error: object) -> ResultsError:
    """The error of a file for a reason."""
    if isinstance(error, OSError) and error.strerror:
        error = error.strerror
    return ResultsError(f"{path}: cannot be read: {error}")


def read_table(path: Path) -> Table:
    """The columns of a file. Raises `ResultsError`: it is no table."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = list(csv.reader(file)) or [[]]
    except (OSError, ValueError, csv.Error) as error:
        raise unreadable(path, error) from None
    if any(len(row) != len(header) for row in rows):
        raise unreadable(path, "its rows differ in length")
    return {name: _column([row[k] for row in rows]) for k, name in enumerate(header)}


def _column(texts: list[str]) -> NDArray[Any]:
    for kind in (np.int64, np.float64):
        try:
            return np.array([int(t) if kind is np.int64 else float(t) for t in texts], dtype=kind)
        except (ValueError, OverflowError):
            continue
    return np.array(texts)
