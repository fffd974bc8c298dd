# SPDX-License-Identifier: Apache-2.0
"""Scores of results against the truth: Tables 2 and 3 and the figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from quadtree_lss.desk.replay.files import write_json
from quadtree_lss.lab.evaluation import metrics
from quadtree_lss.lab.evaluation.consistency import Consistency, consistency
from quadtree_lss.lab.evaluation.provenance import check_truth, recorded_bag, results_config
from quadtree_lss.lab.evaluation.results import (
    EvaluationError,
    Results,
    Truth,
    load_results,
    load_truth,
)
from quadtree_lss.lab.evaluation.scores import EvaluationResult, scores_of
from quadtree_lss.onboard.errors import QuadtreeLssError


def evaluate(
    results_dir: str | Path,
    truth_path: str | Path,
    out: str | Path | None = None,
    *,
    bag: str | Path | None = None,
    consistency: bool = True,
    figures: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> EvaluationResult:
    """Score the results of ``replay`` in ``results_dir`` against ``truth.npz``.

    Writes ``evaluation.json`` and, unless ``figures`` is false, ``report.html`` and PNG figures
    into ``out`` (default: ``results_dir/evaluation``). For the ``consistency`` of Table 2 the
    recording is mapped again with the results' ``config.yaml``: ``bag``, by default the one that
    ``summary.json`` names if it is still there; ``progress(done, total)`` counts its scans.

    Raises `EvaluationError` when a file is missing or malformed, when results, truth and bag are
    not of one flight (`provenance.check_truth`), or when the map and the truth do not overlap.
    """
    results, truth = load_results(results_dir), load_truth(truth_path)
    given = None if bag is None else Path(bag)
    doubt = check_truth(results, Path(results_dir), truth, Path(truth_path), given)
    notes = [] if doubt is None else [doubt]
    heights = metrics.elevation_field(results.map, results.grid, truth)
    safety = metrics.safety_field(results.grid, truth)
    if not safety.scored.size:
        msg = f"the map in {results_dir} does not overlap the scanned box of {truth_path}"
        raise EvaluationError(msg)
    table_2 = None
    if consistency or given is not None:
        table_2, without = _table_2(results, Path(results_dir), given, progress)
        notes += [] if without is None else [f"Table 2: {without}"]
    folder = Path(out) if out is not None else Path(results_dir) / "evaluation"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EvaluationError(f"cannot create {folder}: {error.strerror}") from error
    written: tuple[Path, ...] = ()
    if figures:
        from quadtree_lss.lab.evaluation.figures import draw_all

        written = draw_all(folder, results, truth, heights, safety)
    result = replace(
        scores_of(results, truth, heights, safety),
        consistency=table_2,
        out=folder,
        figures=written,
        notes=tuple(notes),
    )
    if figures:
        result = _with_page(result, Path(results_dir), truth, safety)
    write_json(folder / "evaluation.json", result.as_dict())
    return result


def score(results: Results, truth: Truth) -> EvaluationResult:
    """The scores alone; nothing is written, and there is no Table 2.

    Raises `EvaluationError` when the map and the truth do not overlap.
    """
    safety = metrics.safety_field(results.grid, truth)
    if not safety.scored.size:
        raise EvaluationError("the map does not overlap the scanned box")
    heights = metrics.elevation_field(results.map, results.grid, truth)
    return scores_of(results, truth, heights, safety)


def _with_page(
    result: EvaluationResult, results_dir: Path, truth: Truth, safety: metrics.SafetyField
) -> EvaluationResult:
    """Writes ``report.html``; with a note if the results have not what it shows."""
    from quadtree_lss.lab.evaluation.evaluation_page import evaluation_page

    try:
        text = evaluation_page(results_dir, truth, safety, result)
    except KeyError as error:
        return replace(result, notes=(*result.notes, f"report.html: the results lack {error}"))
    (result.out / "report.html").write_text(text, encoding="utf-8")
    return result


def _table_2(
    results: Results,
    results_dir: Path,
    given: Path | None,
    progress: Callable[[int, int], None] | None,
) -> tuple[Consistency | None, str | None]:
    """Table 2 with the configuration of the results, or why there is none.

    What is wrong with a bag that was given is an error; with one that was merely found, a reason.
    """
    bag = given if given is not None else recorded_bag(results)
    if bag is None:
        return None, "needs --bag"
    if given is None and not results.timing["stamp_ns"].size:
        return None, "needs --bag with the scans: these results are of recorded maps"
    total = results.timing["stamp_ns"].size
    scan_topic, pose_topic = (results.summary.get(f"{what}_topic") for what in ("scan", "pose"))
    try:
        return consistency(
            bag,
            results_config(results_dir),
            results=results,
            scan_topic=scan_topic or None,
            pose_topic=pose_topic or None,
            progress=None if progress is None else lambda done: progress(done, max(done, total)),
        ), None
    except QuadtreeLssError as error:
        if given is not None:
            raise
        return None, f"needs --bag ({error})"
