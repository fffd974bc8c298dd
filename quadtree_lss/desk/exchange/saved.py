# SPDX-License-Identifier: Apache-2.0
"""Reading of a results folder; conversion of a map from and to the arrays of ``cells.npz``."""

from __future__ import annotations

import contextlib
import csv
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.desk.exchange.formats import read_arrays
from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.config.loading import read_values
from quadtree_lss.onboard.config.settings import Config, config_from_values, removal_reason
from quadtree_lss.onboard.core.landing.hazards import UNMAPPED, UNSEEN
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.domain import Domain, carried
from quadtree_lss.onboard.errors import QuadtreeLssError

Table = dict[str, NDArray[Any]]
"""Columns of a CSV file by name, as integers, floats or texts."""
MAP_COLUMNS = ("level", "ix", "iy", "z", "covariance_pose", "count", "measured", "roughness")
MAP_COLUMNS += ("exception_fraction", "feature", "low", "high", "coverage")
"""Arrays of ``cells.npz`` that are attributes of `CellMap`."""
COLUMNS, MASKS = (*MAP_COLUMNS, "nx", "ny", "nz", "covariance"), ("observed_cells", "known_cells")


class ResultsError(QuadtreeLssError):
    """A folder does not contain results, or one of its files cannot be read."""


def cells_arrays(cells: CellMap) -> dict[str, NDArray[Any]]:
    """Convert a map to the content of ``cells.npz``; leaves are in Morton order."""
    domain = cells.domain
    of_domain = [domain.xmin, domain.ymin, domain.size, domain.min_level, domain.max_level]
    return {
        **{name: getattr(cells, name) for name in (*MAP_COLUMNS, "x", "y", "size", "covariance")},
        **{f"n{axis}": cells.normal[:, k] for k, axis in enumerate("xyz")},
        "observed": np.bincount(cells.leaf_raster()[cells.observed], minlength=len(cells.z)),
        "observed_cells": cells.observed,
        "known_cells": cells.known,
        "domain": np.array(of_domain),
        "stamp_ns": np.array(cells.stamp_ns),
        "offset": np.array([cells.offset_z, cells.offset_variance]),
    }


def cell_map(path: str | Path, a: Mapping[str, NDArray[Any]]) -> CellMap:
    """Convert the arrays of ``cells.npz`` to a map. Raises `ResultsError`: they are invalid."""
    missing = [n for n in (*COLUMNS, *MASKS, "domain", "stamp_ns", "offset") if n not in a]
    if missing:
        raise unreadable(path, f"it lacks {', '.join(missing)}: replay the bag again")
    if a["domain"].shape != (5,):
        raise unreadable(path, "domain has another size than 5")
    *place, low, high = a["domain"].tolist()
    domain = Domain(*place, int(low), int(high))
    sides = dict.fromkeys(MASKS, (domain.finest_count,) * 2)
    sides |= {name: (len(a["level"]),) for name in COLUMNS}
    if wrong := [name for name, side in sides.items() if a[name].shape[: len(side)] != side]:
        raise unreadable(path, f"{wrong[0]} has another size than the map")
    kinds = {"level": np.uint8, "measured": np.bool_}
    kinds |= dict.fromkeys(("ix", "iy", "count"), np.uint32)
    return CellMap(
        **{name: a[name].astype(kinds.get(name, a[name].dtype)) for name in MAP_COLUMNS},
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
    if isinstance(error, OSError) and error.strerror:
        error = error.strerror
    return ResultsError(f"{path}: cannot be read: {error}")


def read_table(path: Path) -> Table:
    """Read a CSV file. Raises `ResultsError`: it is not a table."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = list(csv.reader(file)) or [[]]
    except (OSError, ValueError, csv.Error) as error:
        raise unreadable(path, error) from None
    if any(len(row) != len(header) for row in rows):
        raise unreadable(path, "its rows differ in length")
    return {name: _column([row[k] for row in rows]) for k, name in enumerate(header)}


def _column(texts: list[str]) -> NDArray[Any]:
    for kind, dtype in ((int, np.int64), (float, np.float64)):
        with contextlib.suppress(ValueError, OverflowError):
            return np.array([kind(text) for text in texts], dtype)
    return np.array(texts)


class Grid(dict[str, NDArray[Any]]):
    """The landing grid, by the names in ``grid.npz``: ``x`` (nx,) and ``y`` (ny,) of the grid
    points, m, ascending, evenly spaced; layers (ny, nx)."""

    @property
    def x(self) -> Array:
        return self["x"]

    @property
    def y(self) -> Array:
        return self["y"]

    @property
    def layers(self) -> dict[str, NDArray[Any]]:
        return {name: values for name, values in self.items() if name not in ("x", "y")}

    @property
    def spacing(self) -> float:
        """Distance of neighbouring grid points, m."""
        return float(self.x[-1] - self.x[0]) / (self.x.size - 1) if self.x.size > 1 else 1.0

    @property
    def seen(self) -> Mask:
        """(ny, nx): observed and estimated ground."""
        return np.asarray((self["hazard"] & UNSEEN) == 0)

    @property
    def unmapped(self) -> Mask:
        """(ny, nx): observed ground that is not estimated."""
        return np.asarray((self["hazard"] & UNMAPPED) > 0)

    def __repr__(self) -> str:
        shape = f"{len(self.x)} x {len(self.y)} grid points, {self.spacing:g} m apart"
        return f"<Grid: {shape}; {', '.join(self.layers)}>"


@dataclass(frozen=True, repr=False)
class Results:
    """Output of a replay; lengths in m, map frame. Each attribute reads its file on first use and
    raises `ResultsError` if it cannot be read."""

    folder: Path

    @cached_property
    def summary(self) -> dict[str, Any]:
        """``summary.json``; numbers that are not finite are None."""
        path = self.folder / "summary.json"
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise unreadable(path, error) from None
        if not isinstance(content, dict):
            raise unreadable(path, "it is not a JSON object")
        return content

    @cached_property
    def config(self) -> Config:
        """The configuration of the run."""
        values = read_values(self.folder / "config.yaml")
        return config_from_values({k: v for k, v in values.items() if not removal_reason(k)})

    @cached_property
    def sites(self) -> Table:
        """``sites.csv``, best first."""
        return read_table(self.folder / "sites.csv")

    @property
    def positions(self) -> Array:
        """(K, 3) of the ranked sites, best first, m."""
        table = self.sites
        return np.column_stack([np.asarray(table[name], np.float64) for name in "xyz"])

    @cached_property
    def selected(self) -> Table:
        """``selected.csv``: changes of the target."""
        return read_table(self.folder / "selected.csv")

    @cached_property
    def timing(self) -> Table:
        """``timing.csv``: a row per mapped scan."""
        return read_table(self.folder / "timing.csv")

    @cached_property
    def grid(self) -> Grid:
        """``grid.npz``."""
        path = self.folder / "grid.npz"
        grid = Grid(read_arrays(path, kind=ResultsError))
        sides = [grid.get(name, np.empty(0)) for name in "yx"]
        if any(side.ndim != 1 or not side.size for side in sides):
            raise unreadable(path, "it has no grid points x and y")
        shape = tuple(side.size for side in sides)
        wrong = [name for name, values in grid.layers.items() if values.shape != shape]
        if wrong:
            raise unreadable(path, f"{wrong[0]} is not of shape {shape}")
        return grid

    @cached_property
    def map(self) -> CellMap:
        """``cells.npz``: the map of the last assessment."""
        path = self.folder / "cells.npz"
        return cell_map(path, read_arrays(path, kind=ResultsError))

    @cached_property
    def history(self) -> dict[str, NDArray[Any]]:
        """``history.npz``; empty without it."""
        path = self.folder / "history.npz"
        return read_arrays(path, kind=ResultsError) if path.exists() else {}

    def history_layer(self, name: str, answers: NDArray[np.intp]) -> NDArray[np.uint8]:
        """Layer of the history at some assessments (A, ny, nx), bits or risks, shifted to the last
        grid because the domain may follow the vehicle."""
        shape, rows = self.grid["hazard"].shape, self.history[name][answers]
        fill = 255 if name == "risk" else 0
        if not fill:
            rows = np.unpackbits(rows, axis=1, count=shape[0] * shape[1])
        found: NDArray[np.uint8] = rows.reshape(-1, *shape)
        last, spacing = np.array([self.grid.x[0], self.grid.y[0]]), self.grid.spacing
        steps = np.rint((last - self.history["answer_corner"][answers]) / spacing).astype(int)
        for k in np.flatnonzero(steps.any(axis=1)):
            found[k] = carried(found[k], *steps[k].tolist(), fill)
        return found

    @property
    def zone(self) -> float:
        """Radius of the landing zone, m."""
        return 0.5 * self.config.lss.vehicle.diameter + self.config.lss.margin

    @property
    def dispersion(self) -> tuple[float, float]:
        """Touchdown dispersion along x and y, 1 σ, m: the last received, or the setting."""
        heard = (self.summary.get("landing") or {}).get("dispersion")
        x, y = heard[:2] if heard else (self.config.lss.dispersion,) * 2
        return float(x), float(y)

    @property
    def probability(self) -> Array | None:
        """Probability of success (ny, nx), NaN if unknown; None if unknown everywhere."""
        found = self.grid.get("probability")
        return None if found is None or not np.isfinite(found).any() else found

    @property
    def reasons(self) -> list[str]:
        """Reason for each site."""
        rows = len(self.sites["x"])
        return [*self.summary.get("reasons", ()), *[""] * rows][:rows]

    def __repr__(self) -> str:
        scans, sites = self.summary.get("scans"), len(self.positions)
        return f"<Results: {self.folder}: {scans} scans, {sites} sites>"


def load_results(folder: str | os.PathLike[str]) -> Results:
    """Open the results in a folder, such as ``results/latest``. Raises `ResultsError`: it has no
    ``summary.json`` or no ``grid.npz``."""
    path = Path(folder)
    if not path.is_dir():
        raise ResultsError(f"{path} is not a results folder")
    for name in ("summary.json", "grid.npz"):
        if not (path / name).is_file():
            raise ResultsError(f"{path} has no {name}: replay did not write this folder")
    return Results(path)
