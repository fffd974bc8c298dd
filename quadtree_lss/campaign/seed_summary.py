# SPDX-License-Identifier: Apache-2.0
"""Scores of many seeds together."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from quadtree_lss.campaign.statistics import Statistic, summarise, upper_bound
from quadtree_lss.evaluation.evaluate import EvaluationResult, show
from quadtree_lss.replay.results import plain

Row = EvaluationResult


@dataclass(frozen=True)
class Quantity:
    """What is taken from a seed's scores, and which end of it is bad."""

    name: str
    label: str
    unit: str
    digits: int
    worst: Literal["smallest", "largest"]
    value: Callable[[EvaluationResult], float]


QUANTITIES = (
    Quantity(
        "hazardous_found",
        "Hazardous terrain found",
        "%",
        2,
        "smallest",
        lambda r: 100.0 * r.detection.hazardous_found,
    ),
    Quantity(
        "safe_found",
        "Safe terrain found",
        "%",
        1,
        "smallest",
        lambda r: 100.0 * r.detection.safe_found,
    ),
    Quantity(
        "precision",
        "Ground called safe that is",
        "%",
        2,
        "smallest",
        lambda r: 100.0 * r.detection.precision,
    ),
    Quantity(
        "unseen_box",
        "Scanned box out of the score",
        "%",
        2,
        "largest",
        lambda r: 100.0 * r.detection.unseen_box,
    ),
    Quantity("sites", "Sites ranked", "", 1, "smallest", lambda r: r.sites),
    Quantity(
        "unsafe_in_top_five",
        "Unsafe sites in the top five",
        "",
        2,
        "largest",
        lambda r: r.unsafe_in_top_five,
    ),
    Quantity(
        "rms_mean_removed",
        "Elevation RMS, mean removed",
        "m",
        4,
        "largest",
        lambda r: r.elevation.rms_mean_removed,
    ),
    Quantity(
        "mean_absolute",
        "Elevation error, mean absolute",
        "m",
        4,
        "largest",
        lambda r: r.elevation.mean_absolute,
    ),
    Quantity(
        "maximum",
        "Elevation error, largest",
        "m",
        2,
        "largest",
        lambda r: r.elevation.maximum,
    ),
    Quantity("leaves", "Leaves with an estimate", "", 0, "largest", lambda r: r.leaves_estimated),
    Quantity("map_ms_median", "Map update, median", "ms", 2, "largest", lambda r: r.map_ms_median),
    Quantity("map_ms_p99", "Map update, 99 %", "ms", 2, "largest", lambda r: r.map_ms_p99),
    Quantity("lss_ms", "Landing site selection", "ms", 1, "largest", lambda r: r.lss_ms),
)


@dataclass(frozen=True)
class SeedsResult:
    """Scores of many seeds: ``scored`` by seed, ``failed`` with the reason."""

    out: Path
    flight: Mapping[str, Any]
    scored: Mapping[int, EvaluationResult]
    failed: Mapping[int, str]
    interrupted: bool = False

    @property
    def summary(self) -> dict[str, Statistic]:
        """Mean, worst and 95 % interval of each of `QUANTITIES`."""
        seeds = list(self.scored)
        return {
            q.name: summarise(seeds, [q.value(r) for r in self.scored.values()], q.worst)
            for q in QUANTITIES
        }

    @property
    def sites_judged(self) -> tuple[int, int, int]:
        """Top-five sites of all seeds: unsafe, judged, beyond the true terrain."""
        verdicts = [v for r in self.scored.values() for v in r.site_verdicts]
        unknown = verdicts.count("unknown")
        return verdicts.count("unsafe"), len(verdicts) - unknown, unknown

    def table(self) -> str:
        """Aligned lines for people."""
        count = len(self.scored)
        head = ("", "mean", "95 % interval", "worst", "seed")
        rows = [head]
        for quantity in QUANTITIES:
            s = self.summary[quantity.name]
            digits = f".{quantity.digits}f"
            unit = f" [{quantity.unit}]" if quantity.unit else ""
            seed = "-" if s.worst_seed is None else str(s.worst_seed)
            mean, worst = show(s.mean, digits), show(s.worst, digits)
            interval = "-"
            if s.count > 1:
                interval = f"{show(s.low, digits)} … {show(s.high, digits)}"
            rows.append((quantity.label + unit, mean, interval, worst, seed))
        widths = [max(len(row[k]) for row in rows) for k in range(len(head))]
        lines = [
            f"{row[0]:<{widths[0]}}" + "".join(f"  {row[k]:>{widths[k]}}" for k in range(1, 5))
            for row in rows
        ]
        unsafe, judged, unknown = self.sites_judged
        text = f"Truly unsafe sites: {unsafe} of {judged}"
        if judged:
            text += f" (with 95 % confidence ≤ {100.0 * upper_bound(unsafe, judged):.1f} %)"
        if unknown:
            text += f"; {unknown} beyond the true terrain could not be judged"
        seeds = "1 seed" if count == 1 else f"{count} seeds"
        lines += [f"{seeds} of {self.flight['scenario']}", text]
        lines += [f"seed {seed} failed: {reason}" for seed, reason in self.failed.items()]
        return "\n".join(lines)

    def as_dict(self) -> dict[str, Any]:
        """Ready for JSON."""
        unsafe, judged, unknown = self.sites_judged
        content = {
            "flight": dict(self.flight),
            "summary": {name: asdict(value) for name, value in self.summary.items()},
            "sites": {"unsafe": unsafe, "judged": judged, "unknown": unknown},
            "seeds": {str(seed): r.as_dict() for seed, r in self.scored.items()},
            "interrupted": self.interrupted,
            "failed": {str(seed): reason for seed, reason in self.failed.items()},
        }
        plain_content: dict[str, Any] = plain(content)
        return plain_content


def csv_rows(result: SeedsResult) -> list[Mapping[str, Any]]:
    """One row per seed: the quantities and what was missed where."""
    rows: list[Mapping[str, Any]] = []
    for seed, scores in result.scored.items():
        row: dict[str, Any] = {"seed": seed}
        for quantity in QUANTITIES:
            value = float(quantity.value(scores))
            row[quantity.name] = "" if math.isnan(value) else round(value, 6)
        row["missed_grid_points"] = scores.detection.missed_grid_points
        row["missed_depth"] = round(scores.detection.missed_depth, 3)
        largest = scores.missed[0] if scores.missed else None
        row["largest_missed_x"] = round(largest.x, 2) if largest else ""
        row["largest_missed_y"] = round(largest.y, 2) if largest else ""
        rows.append(row)
    return rows
