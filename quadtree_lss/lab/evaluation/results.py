# SPDX-License-Identifier: Apache-2.0
"""Results of ``replay``, truth of ``simulate``, and a check that both belong to one flight."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.desk.exchange import saved
from quadtree_lss.desk.exchange.formats import read_arrays
from quadtree_lss.desk.exchange.saved import Results
from quadtree_lss.desk.replay.results import ReplayResult, grid_of
from quadtree_lss.lab.simulation.safety import LandingGear
from quadtree_lss.lab.simulation.simulate import TRUTH_NAME
from quadtree_lss.lab.simulation.terrain import SimulationError, Terrain
from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.errors import QuadtreeLssError

#: Number of sites that are drawn and evaluated.
TOP = 5
#: Layers of the landing grid that are scored.
LAYERS = ("elevation", "hazard", "safe", "score")
#: Required arrays of ``truth.npz`` with the lengths of their first axes: a number, or the name of
#: another array of that length.
SHAPES: dict[str, tuple[int | str, ...]] = {
    **{name: (name,) for name in ("x", "y", "safe_x", "safe_y")},
    "elevation": ("y", "x"),
    "safe": ("safe_y", "safe_x"),
    "box": (4,),
    "scan_stamp_ns": ("scan_stamp_ns",),
}


class EvaluationError(QuadtreeLssError):
    """Results or truth cannot be scored."""


@dataclass(frozen=True)
class Truth(Terrain):
    """Content of ``truth.npz``, m, map frame."""

    safe_x: Array
    safe_y: Array
    safe: Mask
    box: tuple[float, float, float, float]
    scan_stamp_ns: NDArray[np.int64]
    lander: LandingGear = LandingGear()


def load_truth(path: str | Path) -> Truth:
    """Read ``truth.npz``. Raises `ExchangeError`: it cannot be read; `EvaluationError`: it is no
    truth."""
    file = Path(path)
    found = read_arrays(file, (*SHAPES, "lander"))
    if missing := [name for name in SHAPES if name not in found]:
        raise EvaluationError(f"{file} lacks {', '.join(missing)}")
    return truth_of(found, file)


def truth_of(arrays: Mapping[str, Any], file: Path = Path(TRUTH_NAME)) -> Truth:
    """Make the truth from arrays. Raises `EvaluationError`: their shapes or values are invalid."""
    a = {name: arrays[name] for name in (*SHAPES, "lander") if name in arrays}
    for name, of in SHAPES.items():
        shape, expected = a[name].shape, tuple(a[n].size if isinstance(n, str) else n for n in of)
        too_short = name in ("x", "y", "safe_x", "safe_y") and shape < (2,)
        if shape[: len(of)] != expected or too_short:
            raise EvaluationError(f"{file}: {name} has shape {shape}, expected {expected}")
    a["box"] = tuple(a["box"].tolist())
    a["safe"] = a["safe"].astype(bool)
    try:
        if "lander" in a:
            a["lander"] = LandingGear(*map(float, a["lander"].tolist()))
        return Truth(**a)
    except (SimulationError, TypeError, ValueError) as error:
        raise EvaluationError(f"{file}: {error}") from None


def results_of(replayed: ReplayResult) -> Results:
    """Results of a replay that has no folder."""
    found = Results(Path())
    places = replayed.assessment.sites.position.reshape(-1, 3)
    vars(found).update(
        map=replayed.cells,
        grid=grid_of(replayed.assessment),
        sites=dict(zip("xyz", places.T, strict=True)),
        timing={"stamp_ns": np.array([row.stamp_ns for row in replayed.timings])},
        summary=replayed.summary,
    )
    return found


def load_results(directory: str | Path) -> Results:
    """Read a results folder of ``replay``. Raises `ResultsError`: a file cannot be read;
    `EvaluationError`: it lacks what is scored."""
    folder = Path(directory)
    read = saved.load_results(folder)
    if missing := [name for name in LAYERS if name not in read.grid.layers]:
        raise EvaluationError(f"{folder / 'grid.npz'} lacks {', '.join(missing)}")
    try:
        for part in ("map", "positions", "summary"):  # reads the files
            getattr(read, part)
        read.timing["stamp_ns"] = read.timing["stamp_ns"].astype(np.int64)
        return read
    except (KeyError, ValueError) as error:
        msg = "sites.csv or timing.csv lack a column of numbers"
        raise EvaluationError(f"{folder}: {msg}: {error}") from error


def check_truth(results: Results, truth: Truth, truth_path: Path) -> None:
    """Raise `EvaluationError` unless the truth has the stamp of each mapped scan."""
    stamps = results.timing["stamp_ns"], truth.scan_stamp_ns
    mapped, flown = (np.unique(of[of > 0]) for of in stamps)  # zero means no stamp
    unknown = mapped[~np.isin(mapped, flown)]
    if flown.size and unknown.size:
        msg = f"{truth_path} is of another flight than {results.folder}: {unknown.size} of"
        msg += f" {mapped.size} mapped scans are not among its {flown.size}, the first at"
        raise EvaluationError(f"{msg} {unknown[0]} ns")
