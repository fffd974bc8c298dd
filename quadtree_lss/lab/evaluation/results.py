# SPDX-License-Identifier: Apache-2.0
"""Reading what ``replay`` wrote and what ``simulate`` knows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadtree_lss.desk.exchange.archives import read_arrays
from quadtree_lss.desk.exchange.libraries import ExchangeError
from quadtree_lss.desk.replay import results as saved
from quadtree_lss.desk.replay.result import ReplayResult
from quadtree_lss.lab.simulation.safety import LandingGear
from quadtree_lss.lab.simulation.simulate import TRUTH_NAME
from quadtree_lss.lab.simulation.terrain import bilinear
from quadtree_lss.onboard.arrays import Array, Bytes, Mask
from quadtree_lss.onboard.core.geometry.bounds import bounded
from quadtree_lss.onboard.core.landing.hazards import UNMAPPED, UNSEEN
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.errors import QuadtreeLssError

_CELLS = ("level", "ix", "iy", "x", "y", "size", "z", "nx", "ny", "nz", "measured", "domain")
_CELLS_EXTRA = ("observed", "low", "high")
_GRID = ("x", "y", "elevation", "slope_deg", "hazard", "safe", "score")
_GRID_EXTRA = ("risk",)
_TRUTH = ("x", "y", "elevation", "safe_x", "safe_y", "safe", "box", "scan_stamp_ns")
_TRUTH_EXTRA = ("scan_outline", "scan_flight")
_TRUTH_NAMES = ("bag_name", "seed", "lander")


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table for people: the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for first, *others in rows:
        cells = [f"{cell:>{width}}" for cell, width in zip(others, widths[1:], strict=True)]
        lines.append("  ".join([f"{first:<{widths[0]}}", *cells]))
    return lines


class EvaluationError(QuadtreeLssError):
    """Results or truth that cannot be scored; the text is one clear line."""


@dataclass(frozen=True)
class Leaves:
    """The leaves of a map, one row per leaf (``cells.npz``), metres, map frame."""

    level: NDArray[np.int64]
    ix: NDArray[np.int64]
    iy: NDArray[np.int64]
    x: Array
    y: Array
    size: Array
    z: Array
    normal: Array
    measured: Mask
    domain: Domain
    observed: NDArray[np.int64]
    """Number of the finest cells of each leaf in which a point fell; 0 if the file tells none."""
    low: Array
    high: Array
    """What the heights of each plane keep to (m); NaN for no bound."""

    @property
    def fixed(self) -> bool:
        """Whether the map has one level only (Section VI.B)."""
        return self.domain.min_level == self.domain.max_level

    @property
    def estimated(self) -> Mask:
        """Leaves with a plane, measured or inherited (M,)."""
        return np.isfinite(self.z)

    @cached_property
    def index(self) -> NDArray[np.int64]:
        """Leaf of every finest cell, (n, n) as [iy, ix]; −1 where there is none."""
        n = self.domain.finest_count
        leaf = np.full((n, n), -1, np.int64)
        for level in np.unique(self.level):
            rows = np.flatnonzero(self.level == level)
            side = 1 << int(level)
            coarse = np.full((side, side), -1, np.int64)
            coarse[self.iy[rows], self.ix[rows]] = rows
            fine = np.repeat(np.repeat(coarse, n // side, axis=0), n // side, axis=1)
            leaf = np.where(fine >= 0, fine, leaf)
        return leaf

    @property
    def without_estimate(self) -> float:
        """Fraction of the finest cells in which a point fell whose leaf has no plane."""
        of_all = self.observed.sum()
        return float(self.observed[~self.estimated].sum() / of_all) if of_all else float("nan")

    def elevation_at(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Elevation (m) of the map at map coordinates, the leaves' planes within their bounds; NaN
        without an estimate."""
        x_map, y_map = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        n, size = self.domain.finest_count, self.domain.finest_size
        i = np.floor((x_map - self.domain.xmin) / size).astype(np.int64)
        j = np.floor((y_map - self.domain.ymin) / size).astype(np.int64)
        inside = (i >= 0) & (i < n) & (j >= 0) & (j < n)
        leaf = np.where(inside, self.index[np.clip(j, 0, n - 1), np.clip(i, 0, n - 1)], -1)
        normal = self.normal[leaf]
        with np.errstate(divide="ignore", invalid="ignore"):
            run = normal[..., 0] * (x_map - self.x[leaf]) + normal[..., 1] * (y_map - self.y[leaf])
            z = self.z[leaf] - run / normal[..., 2]
        return np.where(leaf >= 0, bounded(z, self.low[leaf], self.high[leaf]), np.nan)


@dataclass(frozen=True)
class ScoredGrid:
    """Points of the landing grid (``grid.npz``): x (nx,), y (ny,), arrays (ny, nx)."""

    x: Array
    y: Array
    elevation: Array
    slope_deg: Array
    hazard: Bytes
    safe: Mask
    score: Array
    risk: Array | None = None
    """That landing there fails; None where the file tells none, NaN where nobody asked."""

    @property
    def spacing(self) -> float:
        """Distance of neighbouring grid points (m)."""
        return float(self.x[-1] - self.x[0]) / (self.x.size - 1)

    @property
    def seen(self) -> Mask:
        """Grid points on seen ground that is mapped (ny, nx)."""
        return np.asarray((self.hazard & UNSEEN) == 0)

    @property
    def looked_at(self) -> Mask:
        """Grid points on seen ground, mapped or not yet (ny, nx)."""
        return np.asarray(self.seen | ((self.hazard & UNMAPPED) > 0))


@dataclass(frozen=True)
class Results:
    """One results directory of ``replay``."""

    leaves: Leaves
    grid: ScoredGrid
    sites: Array
    """Positions (K, 3) of the ranked sites, best first."""
    map_ms: Array
    """Time per scan (S,), ms."""
    stamps_ns: NDArray[np.int64]
    """Stamps of the mapped scans (S,)."""
    counts: NDArray[np.int64]
    """Of each scan: its points, those of them that were used, leaves after it (S, 3)."""
    summary: dict[str, Any]

    @property
    def bag(self) -> Path | None:
        """The bag that was replayed, as ``summary.json`` names it."""
        name = self.summary.get("bag")
        return Path(name) if isinstance(name, str) and name else None


@dataclass(frozen=True)
class Truth:
    """The ground as it is (``truth.npz``), metres, map frame."""

    x: Array
    y: Array
    elevation: Array
    safe_x: Array
    safe_y: Array
    safe: Mask
    box: tuple[float, float, float, float]
    scan_stamp_ns: NDArray[np.int64]
    scan_outline: Array
    """Edge of each scan on the ground (S, K, 2); K = 0 where the file does not know."""
    scan_flight: NDArray[np.int64]
    """Flight to which each scan belongs (S,)."""
    bag_name: str | None = None
    """Name of the bag beside the file; None where the file does not tell, like ``seed``."""
    seed: int | None = None
    lander: LandingGear = LandingGear()
    """Whose safety it is."""

    def elevation_at(self, x: ArrayLike, y: ArrayLike) -> Array:
        """True elevation (m) at map coordinates; NaN outside the DEM."""
        return bilinear(self.x, self.y, self.elevation, x, y)

    def outlines_of(self, stamps_ns: NDArray[np.int64], every: int) -> tuple[Array, int]:
        """Closed outlines (n, K + 1, 2) of every so-manieth of the given scans; their number."""
        rows = np.flatnonzero(np.isin(self.scan_stamp_ns, stamps_ns))
        if not self.scan_outline.shape[1]:
            return np.empty((0, 1, 2)), 0
        shown = self.scan_outline[rows[::every]]
        return np.concatenate([shown, shown[:, :1]], axis=1), rows.size

    def flights_of(self, stamps_ns: NDArray[np.int64]) -> int:
        """How many flights the given scans are from."""
        return int(np.unique(self.scan_flight[np.isin(self.scan_stamp_ns, stamps_ns)]).size)


def _arrays(path: Path, names: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, Any]:
    try:
        found = read_arrays(path, (*names, *optional))
    except ExchangeError as error:
        near = [p for p in (path / "truth.npz", path.parent / "truth.npz") if p.is_file()]
        hint = f"; did you mean {near[0]}?" if near and path.name != "truth.npz" else ""
        raise EvaluationError(f"{error}{hint}") from error
    if missing := [name for name in names if name not in found]:
        msg = f"{path} lacks {', '.join(missing)}"
        raise EvaluationError(msg)
    return found


def _check_shape(path: Path, arrays: Mapping[str, Any], x: str, y: str, *names: str) -> None:
    for name in (x, y):
        if arrays[name].ndim != 1 or arrays[name].size < 2:
            msg = f"{path}: {name} must be a vector of at least two coordinates"
            raise EvaluationError(msg)
    expected = (arrays[y].size, arrays[x].size)
    for name in names:
        if arrays[name].shape != expected:
            msg = f"{path}: {name} has shape {arrays[name].shape}, expected {expected}"
            raise EvaluationError(msg)


def _check_length(path: Path, name: str, array: NDArray[Any], length: int, of: str) -> None:
    if array.shape[:1] != (length,):
        found = array.shape[0] if array.ndim else "no"
        msg = f"{path}: {name} has {found} rows, expected {of}: {length}"
        raise EvaluationError(msg)


def load_leaves(path: Path) -> Leaves:
    """Read ``cells.npz``."""
    return _leaves(path, _arrays(path, _CELLS, _CELLS_EXTRA))


def _leaves(path: Path, a: dict[str, Any]) -> Leaves:
    _check_length(path, "domain", a["domain"], 5, "xmin, ymin, size, min_level, max_level")
    a.setdefault("observed", np.zeros_like(a["level"]))
    for name in ("low", "high"):
        a.setdefault(name, np.full(a["level"].size, np.nan))
    for name in (*_CELLS[:-1], *_CELLS_EXTRA):
        _check_length(path, name, a[name], a["level"].size, "one per leaf")
    xmin, ymin, size, min_level, max_level = np.asarray(a["domain"], float)
    return Leaves(
        level=a["level"].astype(np.int64),
        ix=a["ix"].astype(np.int64),
        iy=a["iy"].astype(np.int64),
        x=a["x"].astype(float),
        y=a["y"].astype(float),
        size=a["size"].astype(float),
        z=a["z"].astype(float),
        normal=np.stack([a["nx"], a["ny"], a["nz"]], axis=-1).astype(float),
        measured=a["measured"].astype(bool),
        domain=Domain(*map(float, (xmin, ymin, size)), int(min_level), int(max_level)),
        observed=a["observed"].astype(np.int64),
        low=a["low"].astype(float),
        high=a["high"].astype(float),
    )


def load_grid(path: Path) -> ScoredGrid:
    """Read ``grid.npz``."""
    return _grid(path, _arrays(path, _GRID, _GRID_EXTRA))


def _grid(path: Path, a: dict[str, Any]) -> ScoredGrid:
    extra = [name for name in _GRID_EXTRA if name in a]
    _check_shape(path, a, "x", "y", *_GRID[2:], *extra)
    return ScoredGrid(
        **{**a, "safe": a["safe"].astype(bool), "hazard": a["hazard"].astype(np.uint8)}
    )


def load_truth(path: str | Path) -> Truth:
    """Read ``truth.npz``."""
    file = Path(path)
    return truth_of(_arrays(file, _TRUTH, (*_TRUTH_EXTRA, *_TRUTH_NAMES)), file)


def truth_of(arrays: Mapping[str, Any], file: Path = Path(TRUTH_NAME)) -> Truth:
    """Truth of the content of its ``file``."""
    names = (*_TRUTH, *_TRUTH_EXTRA, *_TRUTH_NAMES)
    a = {name: arrays[name] for name in names if name in arrays}
    _check_shape(file, a, "x", "y", "elevation")
    _check_shape(file, a, "safe_x", "safe_y", "safe")
    _check_length(file, "box", a["box"], 4, "xmin, xmax, ymin, ymax")
    xmin, xmax, ymin, ymax = (float(value) for value in a.pop("box"))
    scans = a["scan_stamp_ns"].size
    a.setdefault("scan_outline", np.empty((scans, 0, 2)))
    a.setdefault("scan_flight", np.zeros(scans, np.int64))
    for name in _TRUTH_EXTRA:
        _check_length(file, name, a[name], scans, "one per scan")
    limits = np.asarray(a.pop("lander", LandingGear().limits), float)
    _check_length(file, "lander", limits, 4, "diameter, pad radius, slope, roughness")
    a["lander"] = LandingGear(*limits.tolist())
    for name, kind in (("bag_name", str), ("seed", int)):
        if name in a:
            a[name] = kind(a[name].item()) if a[name].size == 1 else None
    return Truth(**{**a, "safe": a["safe"].astype(bool)}, box=(xmin, xmax, ymin, ymax))


def results_of(replayed: ReplayResult) -> Results:
    """The results of a replay that wrote none: the same as of a folder."""
    where = Path(str(replayed.summary["bag"]))
    cells, grid = saved.cells_arrays(replayed.cells), saved.grid_arrays(replayed.assessment)
    rows = [(row.points, row.points_used, row.leaves) for row in replayed.timings]
    return Results(
        leaves=_leaves(where, {name: cells[name] for name in (*_CELLS, *_CELLS_EXTRA)}),
        grid=_grid(where, {name: grid[name] for name in (*_GRID, *_GRID_EXTRA)}),
        sites=replayed.assessment.sites.position.reshape(-1, 3),
        map_ms=np.array([row.map_ms for row in replayed.timings], float),
        stamps_ns=np.array([row.stamp_ns for row in replayed.timings], np.int64),
        counts=np.array(rows, np.int64).reshape(-1, 3),
        summary=replayed.summary,
    )


def load_results(directory: str | Path) -> Results:
    """Read a results directory of ``replay``; raises `EvaluationError` if a file is amiss."""
    folder = Path(directory)
    try:
        read = saved.load_results(folder)
        timing, summary, sites = read.timing, read.summary, read.positions
        counts = [timing[name] for name in ("points", "points_used", "leaves")]
        return Results(
            leaves=load_leaves(folder / "cells.npz"),
            grid=load_grid(folder / "grid.npz"),
            sites=sites,
            map_ms=timing["map_ms"].astype(float),
            stamps_ns=timing["stamp_ns"].astype(np.int64),
            counts=np.column_stack(counts).astype(np.int64),
            summary=summary,
        )
    except saved.ResultsError as error:
        raise EvaluationError(str(error)) from error
    except (KeyError, ValueError) as error:
        msg = f"{folder}: sites.csv or timing.csv lack a column of numbers: {error}"
        raise EvaluationError(msg) from error
