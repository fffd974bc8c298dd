# SPDX-License-Identifier: Apache-2.0
"""Evaluation of one run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from quadtree_lss.desk.replay.files import write_json, writing
from quadtree_lss.lab.evaluation.results import (
    EvaluationError,
    Results,
    Truth,
    check_truth,
    load_results,
    load_truth,
)
from quadtree_lss.lab.evaluation.risk_flights import lander_of
from quadtree_lss.lab.evaluation.score import EvaluationResult, score
from quadtree_lss.onboard.errors import QuadtreeLssError


def evaluate(
    results_dir: str | Path,
    truth_path: str | Path,
    out: str | Path | None = None,
    *,
    page: bool = True,
) -> EvaluationResult:
    """Score results of ``replay`` against ``truth.npz``.

    Writes ``evaluation.json`` and, with ``page``, ``report.html`` into ``out`` (default:
    ``results_dir/evaluation``). Raises `EvaluationError`: a file is missing or malformed, results
    and truth are from different flights, or map and truth do not overlap.
    """
    results, truth = load_results(results_dir), load_truth(truth_path)
    check_truth(results, truth, Path(truth_path))
    result, notes = score(results, truth), _lander_notes(results, truth)
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


def _lander_notes(results: Results, truth: Truth) -> list[str]:
    try:
        own = lander_of(results.config).limits
    except QuadtreeLssError:  # no readable configuration
        return []
    if own == truth.lander.limits:
        return []
    form = "{:g} m wide, pads of {:g} m, up to {:g} deg and {:g} m of rise"
    both = form.format(*truth.lander.limits), form.format(*own)
    return ["the truth is of a lander {}, the results of one {}".format(*both)]
