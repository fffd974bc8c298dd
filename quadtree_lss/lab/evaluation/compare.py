# SPDX-License-Identifier: Apache-2.0
"""Several runs over the same ground: Table 3 with a row each, Figs. 11 and 25 with all of them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quadtree_lss.desk.replay.files import new_folder
from quadtree_lss.lab.evaluation.evaluate import EvaluationResult, evaluate, show
from quadtree_lss.lab.evaluation.metrics import elevation_field
from quadtree_lss.lab.evaluation.results import EvaluationError, load_results, load_truth

_COLUMNS = (
    "hazardous",
    "safe",
    "unsafe sites",
    "elevation RMS",
    "largest",
    "leaves",
    "map time",
    "prefit below",
    "prefit above",
)


@dataclass(frozen=True)
class ComparisonResult:
    """Scores by the name of the run, and what was drawn of all together."""

    runs: dict[str, EvaluationResult]
    out: Path
    figures: tuple[Path, ...]

    def as_dict(self) -> dict[str, Any]:
        """Scores by the name of the run, ready for JSON."""
        return {"runs": {name: scores.as_dict() for name, scores in self.runs.items()}}

    def table(self) -> str:
        """A row per run; elevation RMS with the mean removed, Table 2 of one degree of freedom."""
        rows = [("run", *_COLUMNS), *((name, *_cells(r)) for name, r in self.runs.items())]
        widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
        lines = []
        for name, *cells in rows:
            shown = [f"{cell:>{width}}" for cell, width in zip(cells, widths[1:], strict=True)]
            lines.append("  ".join([f"{name:<{widths[0]}}", *shown]))
        for note in dict.fromkeys(note for r in self.runs.values() for note in r.notes):
            names = [name for name, r in self.runs.items() if note in r.notes]
            lines.append(f"{', '.join(names)}: {note}")
        return "\n".join(lines)


def _cells(r: EvaluationResult) -> tuple[str, ...]:
    outside = r.consistency.counts.one_degree if r.consistency is not None else (math.nan,) * 2
    return (
        show(100.0 * r.detection.hazardous_found, ".2f", " %"),
        show(100.0 * r.detection.safe_found, ".2f", " %"),
        f"{r.unsafe_in_top_five} of {len(r.site_verdicts)}",
        show(r.elevation.rms_mean_removed, ".3f", " m"),
        show(r.elevation.maximum, ".2f", " m"),
        str(r.leaves_estimated),
        show(r.map_s_total, ".2f", " s"),
        *(show(100.0 * share, ".2f", " %") for share in outside),
    )


def compare(
    results_dirs: Sequence[str | Path],
    truth_path: str | Path,
    out: str | Path | None = None,
    *,
    consistency: bool = True,
    figures: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> ComparisonResult:
    """Score several results of ``replay`` over the same ground.

    Each is evaluated as by `evaluate`, into ``out/<name>``; what shows them together goes into
    ``out`` (default: a new folder ``results/<time>``). Runs bear the names of their directories.
    Raises `EvaluationError` as `evaluate` does, and for two directories of one name.
    """
    folders = [Path(directory) for directory in results_dirs]
    names = [folder.resolve().name for folder in folders]
    if len(set(names)) < len(names):
        msg = f"runs are told apart by their directories' names, but these are {', '.join(names)}"
        raise EvaluationError(msg)
    together = Path(out) if out is not None else new_folder(Path("results"))
    runs = {
        name: evaluate(
            folder,
            truth_path,
            together / name,
            consistency=consistency,
            figures=figures,
            progress=progress,
        )
        for name, folder in zip(names, folders, strict=True)
    }
    drawn: tuple[Path, ...] = ()
    if figures:
        from quadtree_lss.lab.evaluation.figures import draw_together

        truth = load_truth(truth_path)
        results = {name: load_results(f) for name, f in zip(names, folders, strict=True)}
        last = results[names[-1]]
        drawn = draw_together(
            together,
            truth,
            elevation_field(last.leaves, last.grid, truth),
            {name: r.map_ms for name, r in results.items()},
            {name: r.sites for name, r in results.items()},
        )
    result = ComparisonResult(runs, together, drawn)
    text = json.dumps(result.as_dict()["runs"], indent=2, allow_nan=False) + "\n"
    (together / "evaluation.json").write_text(text, encoding="utf-8")
    return result
