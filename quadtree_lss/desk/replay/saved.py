# SPDX-License-Identifier: Apache-2.0
"""A results folder read back: the map, the landing grid, the tables."""

from __future__ import annotations

import csv
import json
import os
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.loading import load_config, read_values
from quadtree_lss.onboard.config.settings import Config, still_parameters
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.errors import QuadtreeLssError

Table = dict[str, NDArray[Any]]
"""Columns of a CSV file by name: whole numbers, numbers, or else texts."""


class ResultsError(QuadtreeLssError):
    """A folder is none that a replay wrote, or one of its files cannot be read."""


@dataclass(frozen=True, repr=False)
class Grid:
    """The landing grid: grid points and what is known at each.

    Attributes:
        x, y: (nx,), (ny,) of the grid points, m, ascending, evenly spaced.
        layers: (ny, nx) arrays by the names in ``grid.npz``.
    """

    x: Array
    y: Array
    layers: dict[str, NDArray[Any]]

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.layers[name]

    @property
    def spacing(self) -> float:
        """Distance of neighbouring grid points, m."""
        return float(self.x[1] - self.x[0]) if len(self.x) > 1 else 1.0

    def __repr__(self) -> str:
        shape = f"{len(self.x)} x {len(self.y)} grid points, {self.spacing:g} m apart"
        return f"<Grid: {shape}; {', '.join(self.layers)}>"


@dataclass(frozen=True, repr=False)
class Results:
    """What a replay wrote; each file is read when it is asked for.

    Every attribute raises `ResultsError` if its file cannot be read.
    """

    folder: Path

    @cached_property
    def summary(self) -> dict[str, Any]:
        """``summary.json``."""
        path = self.folder / "summary.json"
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise _unreadable(path, error) from None
        if not isinstance(content, dict):
            raise _unreadable(path, "it is not a JSON object")
        return content

    @cached_property
    def config(self) -> Config:
        """The configuration of the run."""
        path = self.folder / "config.yaml"
        return load_config([], still_parameters(read_values(path)), origin=str(path))

    @cached_property
    def sites(self) -> Table:
        """``sites.csv``, best first."""
        return _read_table(self.folder / "sites.csv")

    @property
    def positions(self) -> Array:
        """(K, 3) of the ranked sites, best first, m."""
        table = self.sites
        return np.column_stack([np.asarray(table[name], np.float64) for name in "xyz"])

    @cached_property
    def selected(self) -> Table:
        """``selected.csv``: changes of the target."""
        return _read_table(self.folder / "selected.csv")

    @cached_property
    def timing(self) -> Table:
        """``timing.csv``: a row per mapped scan."""
        return _read_table(self.folder / "timing.csv")

    @cached_property
    def grid(self) -> Grid:
        """``grid.npz``."""
        path = self.folder / "grid.npz"
        arrays = _read_arrays(path)
        x, y = (arrays.pop(name, np.empty(0)) for name in "xy")
        if x.ndim != 1 or y.ndim != 1 or not x.size or not y.size:
            raise _unreadable(path, "it has no grid points x and y")
        wrong = [name for name, values in arrays.items() if values.shape != (y.size, x.size)]
        if wrong:
            raise _unreadable(path, f"{wrong[0]} is not of shape {(y.size, x.size)}")
        return Grid(x, y, arrays)

    @cached_property
    def map(self) -> CellMap:
        """``cells.npz``: the map that landing sites were ranked on, as it was."""
        path = self.folder / "cells.npz"
        return _cell_map(path, _read_arrays(path))

    def __repr__(self) -> str:
        scans, sites = self.summary.get("scans"), len(self.positions)
        return f"<Results: {self.folder}: {scans} scans, {sites} sites>"


def load_results(folder: str | os.PathLike[str]) -> Results:
    """The results of a replay, for instance of ``results/latest``.

    Raises:
        ResultsError: the folder has no ``summary.json`` or no ``grid.npz``.
    """
    path = Path(folder)
    if not path.is_dir():
        msg = f"{path} is not a results folder"
        raise ResultsError(msg)
    for name in ("summary.json", "grid.npz"):
        if not (path / name).is_file():
            msg = f"{path} has no {name}: replay did not write this folder"
            if (path / "latest" / name).is_file():
                msg += f"; did you mean {path / 'latest'}?"
            raise ResultsError(msg)
    return Results(path)


def _cell_map(path: Path, a: Mapping[str, NDArray[Any]]) -> CellMap:
    needed = ("level", "ix", "iy", "z", "nx", "ny", "nz", "covariance", "covariance_pose", "count")
    needed += ("measured", "roughness", "exception_fraction", "feature", "observed_cells")
    needed += ("domain", "stamp_ns", "offset")
    missing = [name for name in needed if name not in a]
    if missing:
        raise _unreadable(path, f"it lacks {', '.join(missing)}: replay the bag again")
    xmin, ymin, size, low, high = a["domain"].tolist()
    domain = Domain(xmin, ymin, size, int(low), int(high))
    leaves = len(a["level"])
    sides = (domain.finest_count,) * 2
    wrong = [name for name in needed[:-4] if len(a[name]) != leaves]
    wrong += [name for name in ("low", "high") if a.get(name, a["z"]).shape != (leaves,)]
    masks = ("observed_cells", "known_cells")
    wrong += [name for name in masks if a.get(name, a["observed_cells"]).shape != sides]
    if wrong:
        raise _unreadable(path, f"{wrong[0]} has another size than the map")
    observed, measured = a["observed_cells"].astype(np.bool_), a["measured"].astype(np.bool_)
    unbounded = np.full(leaves, np.nan)
    found = CellMap(
        stamp_ns=int(a["stamp_ns"]),
        domain=domain,
        level=a["level"].astype(np.uint8),
        ix=a["ix"].astype(np.uint32),
        iy=a["iy"].astype(np.uint32),
        z=a["z"],
        normal=np.column_stack([a["nx"], a["ny"], a["nz"]]),
        covariance_range=a["covariance"] - a["covariance_pose"],
        covariance_pose=a["covariance_pose"],
        count=a["count"].astype(np.uint32),
        measured=measured,
        roughness=a["roughness"],
        exception_fraction=a["exception_fraction"],
        feature=a["feature"],
        low=a.get("low", unbounded),
        high=a.get("high", unbounded),
        observed=observed,
        known=a.get("known_cells", observed).astype(np.bool_),
        offset_z=float(a["offset"][0]),
        offset_variance=float(a["offset"][1]),
    )
    if "known_cells" in a:
        return found
    return replace(found, known=observed & measured[found.leaf_raster()])


def _read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, AttributeError, TypeError) as error:
        raise _unreadable(path, error) from None
    except (zipfile.BadZipFile, zlib.error) as error:
        raise _unreadable(path, error) from None


def _read_table(path: Path) -> Table:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = list(csv.reader(file)) or [[]]
    except (OSError, ValueError, csv.Error) as error:
        raise _unreadable(path, error) from None
    if any(len(row) != len(header) for row in rows):
        raise _unreadable(path, "its rows differ in length")
    return {name: _column([row[k] for row in rows]) for k, name in enumerate(header)}


def _column(texts: list[str]) -> NDArray[Any]:
    for kind in (np.int64, np.float64):
        try:
            return np.array([int(t) if kind is np.int64 else float(t) for t in texts], dtype=kind)
        except (ValueError, OverflowError):
            continue
    return np.array(texts)


def _unreadable(path: Path, error: object) -> ResultsError:
    if isinstance(error, OSError) and error.strerror:
        error = error.strerror
    return ResultsError(f"{path}: cannot be read: {error}")
