# SPDX-License-Identifier: Apache-2.0
"""A results folder, written and read back: names, keys and units other tools rely on."""

from __future__ import annotations

import contextlib
import json
import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.desk.exchange.saved import (
    ResultsError,
    Table,
    cell_map,
    cells_arrays,
    read_table,
    unreadable,
)
from quadtree_lss.desk.replay.configuration import dump_config, load_config
from quadtree_lss.desk.replay.files import write_bytes, write_csv, write_json, write_npz
from quadtree_lss.desk.replay.history import History
from quadtree_lss.desk.replay.passes import TargetChange
from quadtree_lss.desk.replay.result import ReplayResult, ScanTiming
from quadtree_lss.desk.replay.stream import ReplayError
from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.config.loading import read_values
from quadtree_lss.onboard.config.settings import Config, still_parameters
from quadtree_lss.onboard.core.landing.hazards import UNSEEN
from quadtree_lss.onboard.core.landing.sites import LandingAssessment
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.elevation.archives import read_arrays
from quadtree_lss.onboard.elevation.libraries import ExchangeError
from quadtree_lss.onboard.messages.maps import known_probability

SITE_COLUMNS = ("rank", "x", "y", "z", "nx", "ny", "nz", "score", "slope_deg", "roughness")
SITE_COLUMNS += ("hazard_distance", "subscale_height", "id", "probability")
REPORT = "report.html"
FIGURES = ("elevation", "slope", "hazards", "probability", "score", "timing")
"""Names of the figures, ``figures/<name>.png``, in the order of the page."""


def write_results(
    out: Path, result: ReplayResult, config: Config, report: bool, history: History | None = None
) -> None:
    """The files of a results folder, which is made if it is missing; ``report`` adds the page.
    Raises `ReplayError`: they cannot be written."""
    try:
        _write(out, result, config, report, history or History())
    except OSError as error:
        raise ReplayError(f"{out}: cannot be written: {error.strerror}") from None


def _write(out: Path, result: ReplayResult, config: Config, report: bool, history: History) -> None:
    write_csv(out / "sites.csv", SITE_COLUMNS, _site_rows(result.assessment))
    write_csv(out / "selected.csv", TargetChange._fields, result.targets)
    write_npz(out / "cells.npz", cells_arrays(result.cells))
    write_npz(out / "grid.npz", grid_arrays(result.assessment))
    rows = ([*row[:-1], f"{row.map_ms:.4f}"] for row in result.timings)
    write_csv(out / "timing.csv", ScanTiming._fields, rows)
    write_npz(out / "history.npz", history.arrays(probability=report))
    write_bytes(out / "config.yaml", dump_config(config).encode())
    write_json(out / "summary.json", result.summary)
    _remove_report(out)
    if report:
        write_report(out)


def write_report(out: Path) -> None:
    """Page and figures of a results folder, made of its other files."""
    from quadtree_lss.desk.report.report import report_files  # matplotlib takes long to import

    for name, content in report_files(out).items():
        write_bytes(out / name, content)


def _remove_report(out: Path) -> None:
    """Takes away page, figures and evaluation of an earlier run, which would contradict this one.

    Of the folder ``evaluation`` those files go that `evaluate` writes.
    """
    (out / REPORT).unlink(missing_ok=True)
    for name in FIGURES:
        (out / "figures" / f"{name}.png").unlink(missing_ok=True)
    folder = out / "evaluation"
    for path in (*folder.glob("fig[0-9][0-9]_*.png"), folder / "evaluation.json", folder / REPORT):
        path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # not there, or somebody else's files in it
        folder.rmdir()


def _site_rows(assessment: LandingAssessment) -> list[list[Any]]:
    """Ranked sites, best first; map frame, m."""
    sites = assessment.sites
    names = ("score", "slope_deg", "roughness", "hazard_distance", "subscale_height")
    columns = [sites.position, sites.normal, *(getattr(sites, name) for name in names)]
    return [
        [rank, *map(float, row), int(number), float(probability)]
        for rank, (row, number, probability) in enumerate(
            zip(np.column_stack(columns), sites.id, sites.probability, strict=True), start=1
        )
    ]


def grid_arrays(assessment: LandingAssessment) -> dict[str, NDArray[Any]]:
    """Content of ``grid.npz``: the landing grid's points, arrays (ny, nx)."""
    names = ("x", "y", "elevation", "plane_elevation", "slope_deg", "hazard", "safe", "score")
    arrays = {name: getattr(assessment, name) for name in (*names, "risk")}
    layers = {name: getattr(assessment, name) for name in ("shadow", "reach")}
    more = {name: values for name, values in layers.items() if values is not None}
    return {**arrays, "probability": known_probability(assessment), **more}


@dataclass(frozen=True, repr=False)
class Grid:
    """The landing grid: grid points and what is known at each. ``x``, ``y``: (nx,), (ny,) of the
    grid points, m, ascending, evenly spaced. ``layers``: (ny, nx) arrays by the names in
    ``grid.npz``."""

    x: Array
    y: Array
    layers: dict[str, NDArray[Any]]

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.layers[name]

    @property
    def spacing(self) -> float:
        """Distance of neighbouring grid points, m."""
        return float(self.x[-1] - self.x[0]) / (self.x.size - 1) if self.x.size > 1 else 1.0

    @property
    def seen(self) -> Mask:
        """(ny, nx) of the grid points on seen ground that is mapped."""
        return np.asarray((self["hazard"] & UNSEEN) == 0)

    def __repr__(self) -> str:
        shape = f"{len(self.x)} x {len(self.y)} grid points, {self.spacing:g} m apart"
        return f"<Grid: {shape}; {', '.join(self.layers)}>"


def grid_of(assessment: LandingAssessment) -> Grid:
    """What ``grid.npz`` would hold."""
    arrays = grid_arrays(assessment)
    return Grid(arrays.pop("x"), arrays.pop("y"), arrays)


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
            raise unreadable(path, error) from None
        if not isinstance(content, dict):
            raise unreadable(path, "it is not a JSON object")
        return content

    @cached_property
    def config(self) -> Config:
        """The configuration of the run."""
        path = self.folder / "config.yaml"
        return load_config([], still_parameters(read_values(path)), origin=str(path))

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
        arrays = _arrays(path)
        x, y = (arrays.pop(name, np.empty(0)) for name in "xy")
        if x.ndim != 1 or y.ndim != 1 or not x.size or not y.size:
            raise unreadable(path, "it has no grid points x and y")
        wrong = [name for name, values in arrays.items() if values.shape != (y.size, x.size)]
        if wrong:
            raise unreadable(path, f"{wrong[0]} is not of shape {(y.size, x.size)}")
        return Grid(x, y, arrays)

    @cached_property
    def map(self) -> CellMap:
        """``cells.npz``: the map that landing sites were ranked on, as it was."""
        path = self.folder / "cells.npz"
        return cell_map(path, _arrays(path))

    def __repr__(self) -> str:
        scans, sites = self.summary.get("scans"), len(self.positions)
        return f"<Results: {self.folder}: {scans} scans, {sites} sites>"


def load_results(folder: str | os.PathLike[str]) -> Results:
    """The results of a replay, for instance of ``results/latest``. Raises `ResultsError`: the
    folder has no ``summary.json`` or no ``grid.npz``."""
    path = Path(folder)
    if not path.is_dir():
        raise ResultsError(f"{path} is not a results folder")
    for name in ("summary.json", "grid.npz"):
        if not (path / name).is_file():
            msg = f"{path} has no {name}: replay did not write this folder"
            if (path / "latest" / name).is_file():
                msg += f"; did you mean {path / 'latest'}?"
            raise ResultsError(msg)
    return Results(path)


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    try:
        return read_arrays(path)
    except ExchangeError as error:
        raise ResultsError(error) from None
