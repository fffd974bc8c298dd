# SPDX-License-Identifier: Apache-2.0
"""Score one results directory against the truth: Tables 2 and 3 and the figures."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from quadtree_lss.evaluation.metrics import (
    Detection,
    ElevationError,
    MissedPlace,
    SiteVerdict,
    detection,
    elevation_error,
    elevation_field,
    missed_places,
    safety_field,
    site_verdicts,
)
from quadtree_lss.evaluation.results import EvaluationError, load_results, load_truth
from quadtree_lss.replay.results import plain

if TYPE_CHECKING:
    from quadtree_lss.evaluation.consistency import Consistency

_TOP = 5


@dataclass(frozen=True)
class EvaluationResult:
    """Scores of one run, and what was written.

    Sites are those of the first five ranks: ``site_verdicts`` has one word for each, in order, and
    ``unknown_in_top_five`` counts those that the truth cannot judge. ``missed`` are the hazardous
    places called safe. ``consistency`` is None unless the bag was at hand.
    """

    elevation: ElevationError
    detection: Detection
    sites: int
    unsafe_in_top_five: int
    unknown_in_top_five: int
    site_verdicts: tuple[SiteVerdict, ...]
    missed: tuple[MissedPlace, ...]
    leaves: int
    leaves_estimated: int
    leaves_measured: int
    map_ms_median: float
    map_ms_p99: float
    map_s_total: float
    lss_ms: float
    consistency: Consistency | None
    out: Path
    figures: tuple[Path, ...]

    def as_dict(self) -> dict[str, Any]:
        """Numbers only, ready for JSON; None stands for a number that does not exist."""
        values = asdict(self)
        values.pop("out")
        values.pop("figures")
        return {key: plain(value) for key, value in values.items()}

    def table(self) -> str:
        """A few aligned lines for people."""
        e, d = self.elevation, self.detection
        rows = [
            ("Elevation error, mean absolute", f"{e.mean_absolute:.3f} m"),
            ("  RMS / largest", f"{e.rms:.3f} / {e.maximum:.2f} m"),
            ("  mean", f"{e.mean:+.3f} m"),
            ("  RMS with the mean removed", f"{e.rms_mean_removed:.3f} m"),
            ("Seen terrain without an estimate", _percent(e.without_estimate)),
            ("Hazardous terrain found", _percent(d.hazardous_found)),
            ("  of it as unknown", _percent(d.hazardous_unknown)),
            ("Safe terrain found", _percent(d.safe_found)),
            ("  not seen", _percent(d.safe_unknown)),
            ("Scanned box out of the score (unseen)", _percent(d.unseen_box)),
            (f"Truly unsafe sites in the top {_TOP}", self._unsafe_sites()),
            ("Leaves with an estimate / all", f"{self.leaves_estimated} / {self.leaves}"),
            ("Map update, median / 99 %", f"{self.map_ms_median:.2f} / {self.map_ms_p99:.2f} ms"),
            ("Landing site selection", f"{self.lss_ms:.1f} ms"),
        ]
        width = max(len(label) for label, _ in rows)
        lines = [f"{label:<{width}}  {value}" for label, value in rows]
        if self.consistency is not None:
            lines += ["", self.consistency.table()]
        return "\n".join(lines)

    def _unsafe_sites(self) -> str:
        text = f"{self.unsafe_in_top_five} of {len(self.site_verdicts)}"
        unknown = [k for k, v in enumerate(self.site_verdicts, start=1) if v == "unknown"]
        if unknown:
            ranks = ", ".join(map(str, unknown))
            text += f" (rank {ranks} beyond the true terrain: cannot be judged)"
        return text


def _percent(fraction: float) -> str:
    return "-" if math.isnan(fraction) else f"{100.0 * fraction:.2f} %"


def evaluate(
    results_dir: str | Path,
    truth_path: str | Path,
    out: str | Path | None = None,
    *,
    bag: str | Path | None = None,
    figures: bool = True,
) -> EvaluationResult:
    """Score the results of ``replay`` in ``results_dir`` against ``truth.npz``.

    Writes ``evaluation.json`` and, unless ``figures`` is false, PNG figures into ``out`` (default:
    ``results_dir/evaluation``). With ``bag``, the recording that was replayed, it is mapped again
    with the results' ``config.yaml`` for the consistency of Table 2. Raises `EvaluationError` when
    a file is missing or malformed or the map and the truth do not overlap.
    """
    results, truth = load_results(results_dir), load_truth(truth_path)
    leaves, grid = results.leaves, results.grid
    heights = elevation_field(leaves, grid, truth)
    safety = safety_field(grid, truth)
    if not safety.scored.size:
        msg = f"the map in {results_dir} does not overlap the scanned box of {truth_path}"
        raise EvaluationError(msg)
    folder = Path(out) if out is not None else Path(results_dir) / "evaluation"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        msg = f"cannot create {folder}: {error.strerror}"
        raise EvaluationError(msg) from error
    verdicts = site_verdicts(results.sites[:_TOP], truth)
    written: tuple[Path, ...] = ()
    if figures:
        from quadtree_lss.evaluation.figures import draw_all

        written = draw_all(folder, results, truth, heights, safety)
    times = results.map_ms if results.map_ms.size else np.array([math.nan])
    result = EvaluationResult(
        elevation=elevation_error(heights),
        detection=detection(safety),
        sites=len(results.sites),
        unsafe_in_top_five=verdicts.count("unsafe"),
        unknown_in_top_five=verdicts.count("unknown"),
        site_verdicts=verdicts,
        missed=missed_places(safety, truth),
        leaves=leaves.level.size,
        leaves_estimated=int(leaves.estimated.sum()),
        leaves_measured=int((leaves.measured & leaves.estimated).sum()),
        map_ms_median=float(np.median(times)),
        map_ms_p99=float(np.percentile(times, 99.0)),
        map_s_total=float(times.sum() * 1e-3),
        lss_ms=float(results.summary.get("lss_ms") or math.nan),
        consistency=None if bag is None else _consistency(bag, Path(results_dir)),
        out=folder,
        figures=written,
    )
    text = json.dumps(result.as_dict(), indent=2, allow_nan=False)
    (folder / "evaluation.json").write_text(text + "\n", encoding="utf-8")
    return result


def _consistency(bag: str | Path, results_dir: Path) -> Consistency:
    """Table 2 with the configuration of the results."""
    from quadtree_lss.configuration import load_config
    from quadtree_lss.evaluation.consistency import consistency  # maps: the whole core

    config = results_dir / "config.yaml"
    return consistency(bag, load_config([str(config)] if config.is_file() else []))
