# SPDX-License-Identifier: Apache-2.0
"""A results folder, written: names, keys and units other tools rely on."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np

from quadtree_lss.desk.exchange.saved import (
    Grid,
    Results,
    ResultsError,
    Table,
    cells_arrays,
    load_results,
)
from quadtree_lss.desk.replay.configuration import dump_config
from quadtree_lss.desk.replay.files import write_bytes, write_csv, write_json, write_npz
from quadtree_lss.desk.replay.history import History
from quadtree_lss.desk.replay.passes import TargetChange
from quadtree_lss.desk.replay.result import ReplayResult, ScanTiming
from quadtree_lss.desk.replay.stream import ReplayError
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.sites import LandingAssessment
from quadtree_lss.onboard.messages.maps import known_probability

__all__ = ["Grid", "Results", "ResultsError", "Table", "cells_arrays", "grid_of", "load_results"]
__all__ += ["write_report", "write_results"]
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
    write_npz(out / "grid.npz", grid_of(result.assessment))
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


def grid_of(assessment: LandingAssessment) -> Grid:
    """What ``grid.npz`` holds."""
    names = ("x", "y", "elevation", "plane_elevation", "slope_deg", "hazard", "safe", "score")
    found = Grid({name: getattr(assessment, name) for name in (*names, "risk")})
    found["probability"] = known_probability(assessment)
    layers = {name: getattr(assessment, name) for name in ("shadow", "reach")}
    found |= {name: values for name, values in layers.items() if values is not None}
    return found
