# SPDX-License-Identifier: Apache-2.0
"""Results of ``replay``, truth of ``simulate``, and a check that both are of one flight."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.desk.exchange import saved
from quadtree_lss.desk.exchange.archives import read_arrays
from quadtree_lss.desk.exchange.libraries import ExchangeError
from quadtree_lss.desk.exchange.saved import Results
from quadtree_lss.desk.replay.results import ReplayResult, grid_of
from quadtree_lss.lab.simulation.safety import LandingGear
from quadtree_lss.lab.simulation.simulate import TRUTH_NAME
from quadtree_lss.lab.simulation.terrain import SimulationError, Terrain
from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.errors import QuadtreeLssError

#: Sites that are drawn and judged.
TOP = 5
#: Layers of the landing grid that are scored.
LAYERS = ("elevation", "hazard", "safe", "score")
#: Columns of ``timing.csv``.
COLUMNS = ("stamp_ns", "points", "points_used", "leaves", "map_ms")
_TRUTH = ("x", "y", "elevation", "safe_x", "safe_y", "safe", "box", "scan_stamp_ns")
_TRUTH_EXTRA = ("scan_outline", "scan_flight")
_TRUTH_NAMES = ("bag_name", "seed", "lander")
#: Lengths of the first axes: a number, or the length of another array.
_SHAPES: dict[str, tuple[int | str, ...]] = {n: (n,) for n in ("x", "y", "safe_x", "safe_y")}
_SHAPES |= {"elevation": ("y", "x"), "safe": ("safe_y", "safe_x"), "box": (4,), "lander": (4,)}
_SHAPES |= dict.fromkeys(_TRUTH_EXTRA, ("scan_stamp_ns",))


class EvaluationError(QuadtreeLssError):
    """Results or truth that cannot be scored; the text is one clear line."""


@dataclass(frozen=True)
class Truth(Terrain):
    """Content of ``truth.npz``, metres, map frame.

    Attributes:
        scan_outline: Edge of each scan on the ground (S, K, 2); K = 0 if unknown.
        scan_flight: Number of the flight of each scan (S,).
        bag_name, seed: Of the bag beside the file; None if unknown.
        lander: The vehicle whose safety it is.
    """

    safe_x: Array
    safe_y: Array
    safe: Mask
    box: tuple[float, float, float, float]
    scan_stamp_ns: NDArray[np.int64]
    scan_outline: Array
    scan_flight: NDArray[np.int64]
    bag_name: str | None = None
    seed: int | None = None
    lander: LandingGear = LandingGear()

    def outlines_of(self, stamps_ns: NDArray[np.int64], every: int) -> tuple[Array, int]:
        """Closed outlines (n, K + 1, 2) of every ``every``-th given scan; number of these scans."""
        rows = np.flatnonzero(np.isin(self.scan_stamp_ns, stamps_ns))
        if not self.scan_outline.shape[1]:
            return np.empty((0, 1, 2)), 0
        shown = self.scan_outline[rows[::every]]
        return np.concatenate([shown, shown[:, :1]], axis=1), rows.size


def load_truth(path: str | Path) -> Truth:
    """Read ``truth.npz``. Raises `EvaluationError`: it is missing or malformed."""
    file = Path(path)
    try:
        found = read_arrays(file, (*_TRUTH, *_TRUTH_EXTRA, *_TRUTH_NAMES))
    except ExchangeError as error:
        raise EvaluationError(str(error)) from error
    if missing := [name for name in _TRUTH if name not in found]:
        raise EvaluationError(f"{file} lacks {', '.join(missing)}")
    return truth_of(found, file)


def truth_of(arrays: Mapping[str, Any], file: Path = Path(TRUTH_NAME)) -> Truth:
    a = {name: arrays[name] for name in (*_TRUTH, *_TRUTH_EXTRA, *_TRUTH_NAMES) if name in arrays}
    scans = a["scan_stamp_ns"].size
    a.setdefault("scan_outline", np.empty((scans, 0, 2)))
    a.setdefault("scan_flight", np.zeros(scans, np.int64))
    a["lander"] = np.asarray(a.get("lander", LandingGear().limits), float)
    for name, of in _SHAPES.items():
        shape, expected = a[name].shape, tuple(a[n].size if isinstance(n, str) else n for n in of)
        if shape[: len(of)] != expected or (of == (name,) and shape < (2,)):
            raise EvaluationError(f"{file}: {name} has shape {shape}, expected {expected}")
    for name, kind in (("bag_name", str), ("seed", int)):
        if name in a:
            a[name] = kind(a[name].item()) if a[name].size == 1 else None
    a["box"], a["lander"] = tuple(a["box"].tolist()), LandingGear(*a["lander"].tolist())
    try:
        return Truth(**{**a, "safe": a["safe"].astype(bool)})
    except SimulationError as error:
        raise EvaluationError(f"{file}: {error}") from None


def results_of(replayed: ReplayResult) -> Results:
    """Results of a replay without a folder."""
    rows, found = replayed.timings, Results(Path())
    places = replayed.assessment.sites.position.reshape(-1, 3)
    vars(found).update(
        map=replayed.cells,
        grid=grid_of(replayed.assessment),
        sites=dict(zip("xyz", places.T, strict=True)),
        timing={name: np.array([getattr(row, name) for row in rows]) for name in COLUMNS},
        summary=replayed.summary,
    )
    return found


def load_results(directory: str | Path) -> Results:
    """Read a results directory of ``replay``; raises `EvaluationError` if a file is amiss."""
    folder = Path(directory)
    try:
        read = saved.load_results(folder)
        if missing := [name for name in LAYERS if name not in read.grid.layers]:
            raise EvaluationError(f"{folder / 'grid.npz'} lacks {', '.join(missing)}")
        for part in ("map", "positions", "summary"):  # reads the files
            getattr(read, part)
        for name in COLUMNS:
            kind = np.float64 if name == "map_ms" else np.int64
            read.timing[name] = read.timing[name].astype(kind)
        return read
    except saved.ResultsError as error:
        raise EvaluationError(str(error)) from error
    except (KeyError, ValueError) as error:
        msg = "sites.csv or timing.csv lack a column of numbers"
        raise EvaluationError(f"{folder}: {msg}: {error}") from error


def named_bag(results: Results) -> Path | None:
    """The bag that ``summary.json`` names."""
    name = results.summary.get("bag")
    return Path(name) if isinstance(name, str) and name else None


def recorded_bag(results: Results) -> Path | None:
    """The named bag if it exists."""
    bag = named_bag(results)
    return bag if bag is not None and bag.is_absolute() and bag.exists() else None


def check_truth(
    results: Results, truth: Truth, truth_path: Path, bag: Path | None = None
) -> str | None:
    """Check that the truth is of the flight that was mapped; return a note if that is uncertain.

    The truth must know the stamp of each mapped scan. Flights of other seeds can have the same
    stamps: they differ in the seed, or in the bag beside the truth. Raises `EvaluationError`: the
    stamps or the seeds differ.
    """
    stamps = results.timing["stamp_ns"], truth.scan_stamp_ns
    mapped, flown = (np.unique(of[of > 0]) for of in stamps)  # zero is no stamp
    strange = mapped[~np.isin(mapped, flown)]
    if flown.size and strange.size:
        msg = f"{truth_path} is of another flight than {results.folder}: {strange.size} of"
        msg += f" {mapped.size} mapped scans are not among its {flown.size}, the first at"
        raise EvaluationError(f"{msg} {strange[0]} ns")
    seed = results.summary.get("seed")
    if seed is not None and truth.seed is not None and seed != truth.seed:
        msg = f"{truth_path} is of seed {truth.seed}, but {results.folder} of seed {seed}"
        raise EvaluationError(msg)
    named = bag or named_bag(results)
    if truth.bag_name is None or named is None or not mapped.size:
        return None
    of_truth, named = (truth_path.parent / truth.bag_name).resolve(), named.resolve()
    if of_truth in (named, named.parent):
        return None
    return f"the truth is of {of_truth}, the results of {named}: check that both are one flight"
