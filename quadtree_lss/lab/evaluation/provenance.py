# SPDX-License-Identifier: Apache-2.0
"""Whether results, truth and bag are of one flight: scores of two flights mean nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.lab.evaluation.results import EvaluationError, Results, Truth
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.errors import QuadtreeLssError


def results_config(results: Results) -> Config:
    """The configuration that lies beside results; the defaults if there is none."""
    path = results.folder / "config.yaml"
    return load_config([str(path)] if path.is_file() else [])


def named_bag(results: Results) -> Path | None:
    """The bag that was replayed, as ``summary.json`` names it."""
    name = results.summary.get("bag")
    return Path(name) if isinstance(name, str) and name else None


def recorded_bag(results: Results) -> Path | None:
    """The same, if it is still where it was."""
    bag = named_bag(results)
    return bag if bag is not None and bag.is_absolute() and bag.exists() else None


def check_truth(
    results: Results, truth: Truth, truth_path: Path, bag: Path | None = None
) -> str | None:
    """Make sure that the truth is of the flight that was mapped; what remains in doubt, in one
    line.

    Every mapped scan must be one the truth knows by its stamp. Flights of several seeds have the
    same stamps; they are told apart by the seed and by the bag that the truth names, as far as the
    files tell. A bag of another name may be the same flight, moved or converted: where both are at
    hand their first scans decide. Raises `EvaluationError`: they are of different flights.
    """
    mapped, flown = (_stamps(of) for of in (results.timing["stamp_ns"], truth.scan_stamp_ns))
    strange = mapped[~np.isin(mapped, flown)]
    if flown.size and strange.size:
        raise EvaluationError(
            f"{truth_path} is of another flight than {results.folder}: {strange.size} of"
            f" {mapped.size} mapped scans are not among its {flown.size}, the first at"
            f" {strange[0]} ns"
        )
    seed = results.summary.get("seed")
    if seed is not None and truth.seed is not None and seed != truth.seed:
        msg = f"{truth_path} is of seed {truth.seed}, but {results.folder} of seed {seed}"
        raise EvaluationError(msg)
    named = bag if bag is not None else named_bag(results)
    if truth.bag_name is None or named is None or not results.timing["stamp_ns"].size:
        return None
    of_truth = truth_path.parent / Path(truth.bag_name).name
    of_results = bag if bag is not None else recorded_bag(results)
    contradiction = f"{truth_path} is of the bag {of_truth.name}, not of {named}"
    same = None
    if of_truth.exists() and of_results is not None:
        same = _same_scans(of_results, of_truth, results_config(results))
        if same is False:
            raise EvaluationError(f"{contradiction}, which holds other scans")
    if same or of_truth.name in (named.name, named.parent.name):
        return None
    if of_truth.exists() and of_results is None:
        raise EvaluationError(contradiction)
    return f"{contradiction}: of one flight by the stamps of their scans alone"


def _stamps(stamps_ns: np.ndarray) -> np.ndarray:
    """Those that tell something: zero is no stamp."""
    return np.unique(stamps_ns[stamps_ns > 0])


def _same_scans(bag: Path, whole: Path, config: Config) -> bool | None:
    """Whether the first scan of a bag is in another one too; None if either cannot be read."""
    from quadtree_lss.desk.replay.replay import scans

    bag, whole = bag.resolve(), whole.resolve()
    if bag == whole or whole in bag.parents:
        return True
    try:
        first = next(scans(bag, config), None)
        if first is None:
            return None
        for scan in scans(whole, config):
            if scan.stamp_ns == first.stamp_ns:
                return np.array_equal(scan.points_lidar, first.points_lidar, equal_nan=True)
    except (QuadtreeLssError, OSError):
        return None
    return False
