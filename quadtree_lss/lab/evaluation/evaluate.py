# SPDX-License-Identifier: Apache-2.0
"""Evaluation of one run: scores, Table 2, figures and page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from quadtree_lss.desk.replay.files import write_json, writing
from quadtree_lss.lab.evaluation.consistency import Consistency
from quadtree_lss.lab.evaluation.consistency import consistency as map_again
from quadtree_lss.lab.evaluation.results import (
    EvaluationError,
    Results,
    Truth,
    check_truth,
    load_results,
    load_truth,
    recorded_bag,
)
from quadtree_lss.lab.evaluation.risk_flights import lander_of
from quadtree_lss.lab.evaluation.score import EvaluationResult, score
from quadtree_lss.onboard.errors import QuadtreeLssError

Progress = Callable[[int, int], None]


def evaluate(
    results_dir: str | Path,
    truth_path: str | Path,
    out: str | Path | None = None,
    *,
    bag: str | Path | None = None,
    consistency: bool = True,
    page: bool = True,
    progress: Progress | None = None,
) -> EvaluationResult:
    """Score results of ``replay`` against ``truth.npz``.

    Writes ``evaluation.json`` and, with ``page``, ``report.html`` into ``out`` (default:
    ``results_dir/evaluation``). For Table 2 (``consistency``) the ``bag``, by default the
    one that ``summary.json`` names, is mapped again; ``progress(done, total)`` counts its scans.

    Raises `EvaluationError`: a file is missing or malformed, results, truth and bag are not of one
    flight (`results.check_truth`), or map and truth do not overlap.
    """
    results, truth = load_results(results_dir), load_truth(truth_path)
    check_truth(results, truth, Path(truth_path))
    result, notes = score(results, truth), _other_lander(results, truth)
    if consistency or bag is not None:
        table_2, missing = _table_2(results, None if bag is None else Path(bag), progress)
        result = replace(result, consistency=table_2)
        notes += [f"Table 2: {missing}"] if missing else []
    folder = Path(out) if out is not None else results.folder / "evaluation"
    with writing(folder, EvaluationError):
        folder.mkdir(parents=True, exist_ok=True)
    result = replace(result, out=folder, notes=tuple(notes))
    if page:
        from quadtree_lss.lab.evaluation.evaluation_page import evaluation_page  # matplotlib

        try:
            text = evaluation_page(results.folder, truth, result)
            (folder / "report.html").write_text(text, encoding="utf-8")
        except KeyError as error:  # the page needs more layers
            result = replace(result, notes=(*notes, f"report.html: the results lack {error}"))
    write_json(folder / "evaluation.json", result.as_dict())
    return result


def _other_lander(results: Results, truth: Truth) -> list[str]:
    try:
        own = lander_of(results.config).limits
    except QuadtreeLssError:  # no readable configuration, which only Table 2 needs
        return []
    if own == truth.lander.limits:
        return []
    form = "{:g} m wide, pads of {:g} m, up to {:g} deg and {:g} m of rise"
    both = form.format(*truth.lander.limits), form.format(*own)
    return ["the truth is of a lander {}, the results of one {}".format(*both)]


def _table_2(
    results: Results, given: Path | None, progress: Progress | None
) -> tuple[Consistency | None, str]:
    """Compute Table 2, or give the reason why there is none. Only faults of a ``given`` bag are
    errors."""
    bag, total = given or recorded_bag(results), results.timing["stamp_ns"].size
    if bag is None:
        return None, "needs --bag"
    if given is None and not total:
        return None, "needs --bag with the scans: these results are of recorded maps"
    names = ("scan_topic", "pose_topic")
    topics = {name: results.summary.get(name) or None for name in names}
    count = None if progress is None else lambda done: progress(done, max(done, total))
    try:
        return map_again(bag, results.config, results=results, progress=count, **topics), ""
    except QuadtreeLssError as error:
        if given is not None:
            raise
        return None, f"needs --bag ({error})"
