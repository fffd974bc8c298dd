# SPDX-License-Identifier: Apache-2.0
"""What a results folder holds, as arrays: all that the page and the figures are made of."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.desk.exchange.saved import read_table
from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.config.settings import Config, config_from_values, still_parameters
from quadtree_lss.onboard.core.landing.hazards import UNMAPPED, UNSEEN
from quadtree_lss.onboard.core.tree.domain import carried
from quadtree_lss.onboard.elevation.archives import read_arrays

Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Content:
    """A results folder, file by file; lengths m, map frame. ``history`` is empty without its file,
    ``sites`` are best first, numbers of ``summary`` that do not exist are None."""

    grid: Arrays
    cells: Arrays
    history: Arrays
    sites: Arrays
    timing: Arrays
    summary: Mapping[str, Any]

    @cached_property
    def config(self) -> Config:
        """What the run was made with."""
        return config_from_values(still_parameters(self.summary["config"]))

    @property
    def seen(self) -> Mask:
        """(ny, nx) of the grid points whose ground is seen and mapped."""
        seen: Mask = (self.grid["hazard"] & UNSEEN) == 0
        return seen

    @property
    def unmapped(self) -> Mask:
        """(ny, nx) of those whose ground is seen, but not yet mapped."""
        unmapped: Mask = (self.grid["hazard"] & UNMAPPED) > 0
        return unmapped

    @property
    def spacing(self) -> float:
        """Of the grid points, m."""
        x = self.grid["x"]
        return float(x[1] - x[0]) if len(x) > 1 else self.config.lss.spacing

    def then(self, name: str, answers: NDArray[np.intp]) -> NDArray[np.uint8]:
        """(A, ny, nx) of the history at some answers, bits or per cent, on the grid of the last: a
        domain that follows lay elsewhere. What was not in it was not seen."""
        shape, rows = self.grid["hazard"].shape, self.history[name][answers]
        fill = 255 if name == "probability" else 0
        if not fill:
            rows = np.unpackbits(rows, axis=1, count=shape[0] * shape[1])
        found: NDArray[np.uint8] = rows.reshape(-1, *shape)
        last = np.array([self.grid["x"][0], self.grid["y"][0]])
        steps = np.rint((last - self.history["answer_corner"][answers]) / self.spacing).astype(int)
        for k in np.flatnonzero(steps.any(axis=1)):
            found[k] = carried(found[k], *steps[k].tolist(), fill)
        return found

    @property
    def zone(self) -> float:
        """Radius of the ground that a landing needs, m."""
        return 0.5 * self.config.lss.vehicle.diameter + self.config.lss.margin

    @property
    def dispersion(self) -> tuple[float, float]:
        """1 sigma of a touchdown about its aim along x and y, m: the last heard, or as set."""
        heard = (self.summary.get("landing") or {}).get("dispersion")
        x, y = heard[:2] if heard else (self.config.lss.dispersion,) * 2
        return float(x), float(y)

    @property
    def probability(self) -> Array | None:
        """(ny, nx) of a safe touchdown, NaN where it was not judged; None if nowhere."""
        found = self.grid.get("probability")
        return None if found is None or not np.isfinite(found).any() else found

    @property
    def places(self) -> Array:
        """(K, 2) of the ranked sites, best first."""
        return np.column_stack([self.sites["x"], self.sites["y"]])

    @property
    def reasons(self) -> list[str]:
        """A sentence for each site."""
        rows = len(self.sites["x"])
        return [*self.summary.get("reasons", ()), *[""] * rows][:rows]


def read(folder: str | Path) -> Content:
    """Reads a folder that ``replay`` wrote."""
    path = Path(folder)
    history = path / "history.npz"
    return Content(
        grid=read_arrays(path / "grid.npz"),
        cells=read_arrays(path / "cells.npz"),
        history=read_arrays(history) if history.exists() else {},
        sites=read_table(path / "sites.csv"),
        timing=read_table(path / "timing.csv"),
        summary=json.loads((path / "summary.json").read_text(encoding="utf-8")),
    )
