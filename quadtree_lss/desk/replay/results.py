# SPDX-License-Identifier: Apache-2.0
"""Result of a replay, its summary, and its folder."""

from __future__ import annotations

import contextlib
import platform
import resource
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import quadtree_lss
from quadtree_lss import build
from quadtree_lss.desk.exchange.saved import Grid, cells_arrays
from quadtree_lss.desk.replay import files
from quadtree_lss.desk.replay.assessments import History, TargetChange
from quadtree_lss.desk.replay.configuration import dump_config
from quadtree_lss.desk.replay.files import ReplayError, plain
from quadtree_lss.onboard.config.settings import Config, values_from_config
from quadtree_lss.onboard.core.landing.result import LandingAssessment
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.messages.lost_points import REASONS, domain_text, lost_points_text
from quadtree_lss.onboard.messages.maps import known_probability

FIGURES = ("elevation", "hazards", "probability", "score")
"""Names of the figures ``figures/<name>.png``."""


class ScanTiming(NamedTuple):
    """A row of ``timing.csv``; ``map_ms`` is from the decoded message to the divided map."""

    stamp_ns: int
    points: int
    points_used: int
    leaves: int
    divisions: int
    map_ms: float


@dataclass(frozen=True, repr=False)
class ReplayResult:
    """The result of a replay. ``out``: folder, if written; ``cells``: map as received by
    ``lss_node``; ``timings``: one row per mapped scan; ``summary``: content of ``summary.json``."""

    out: Path | None
    cells: CellMap
    assessment: LandingAssessment
    timings: tuple[ScanTiming, ...]
    summary: dict[str, Any]
    targets: tuple[TargetChange, ...] = ()

    @property
    def losses(self) -> tuple[str, ...]:
        """One line for each part of the bag that could not be read."""
        return tuple(self.summary["losses"])

    @property
    def warnings(self) -> tuple[str, ...]:
        """One line for each kind of problem, with its count."""
        return tuple(self.summary["warnings"])

    @property
    def interrupted(self) -> bool:
        """True if the replay stopped before the end of the bag."""
        return bool(self.summary["interrupted"])

    def __repr__(self) -> str:
        state = ", interrupted" if self.interrupted else ""
        folder = "" if self.out is None else f", in {self.out}"
        return f"<ReplayResult: {len(self.timings)} scans{state}{folder}; {self.assessment}>"

    def _repr_html_(self) -> str:
        """Return the explanation and the table of sites for notebooks."""
        columns = self.assessment.sites.columns()
        rows = [columns, *zip(*columns.values(), strict=True)]
        texts = ((f"{v:.4f}" if isinstance(v, float) else str(v) for v in row) for row in rows)
        lines = (f"<tr><td>{'</td><td>'.join(line)}</td></tr>" for line in texts)
        return f"<p>{self.assessment.explanation}</p><table>{''.join(lines)}</table>"

    def as_dict(self) -> dict[str, Any]:
        columns = dict(vars(self.assessment.sites))
        rows = [{"rank": k + 1, "reason": text} for k, text in enumerate(columns.pop("reasons"))]
        for k, row in enumerate(rows):
            row |= {name: column[k].tolist() for name, column in columns.items()}
        out = None if self.out is None else str(self.out)
        return dict(plain({"out": out, "sites": rows, **self.summary}))


def run_summary(
    cells: CellMap,
    found: LandingAssessment,
    config: Config,
    lss_ms: float = float("nan"),
    timings: Sequence[ScanTiming] = (),
    **known: Any,
) -> dict[str, Any]:
    """Return the content of ``summary.json``. ``known`` replaces the defaults, which suit a map
    without a bag."""
    map_ms = np.array([row.map_ms for row in timings] or [np.nan])
    stamps = [row.stamp_ns for row in timings]
    return {
        "scans": len(timings),
        "points": sum(row.points for row in timings),
        "leaves": len(cells.level),
        "map_ms_median": float(np.median(map_ms)),
        "map_ms_p99": float(np.percentile(map_ms, 99)),
        "lss_ms": lss_ms,
        "real_time_factor": 0.0,
        "peak_memory_mb": 1.024e-3 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        "versions": versions(),
        "config": values_from_config(config),
        **dict.fromkeys(("scans_dropped", "points_dropped", "messages_rejected", "landing"), {}),
        **dict.fromkeys(("points_used", "poses", "refused_divisions"), 0),
        **dict.fromkeys(("scan_rate", "pose_rate", "range_noise_ratio"), float("nan")),
        **dict.fromkeys(("scan_topic", "pose_topic"), ""),
        "first_stamp_ns": min(stamps, default=None),
        "last_stamp_ns": max(stamps, default=None),
        "maps": 1,
        "target": found.selected.id,
        "target_why": found.why,
        "target_reason": "".join(found.selected.site.reasons),
        "target_changes": int(found.selected.id > 0),
        "explanation": found.explanation,
        "doubts": found.warnings,
        "reasons": found.sites.reasons,
        "interrupted": False,
        "losses": (),
        "warnings": found.warnings,
        **known,
    }


def versions() -> dict[str, str]:
    own = {"quadtree_lss": quadtree_lss.__version__, "build": build.name()}
    own["python"] = platform.python_version()
    return own | {name: version(name) for name in ("numpy", "scipy", "rosbags")}


def write_results(
    out: Path, result: ReplayResult, config: Config, report: bool, history: History | None = None
) -> None:
    """Write a results folder; ``report`` adds page and figures. Raises `ReplayError`: it cannot be
    written."""
    sites = result.assessment.sites.columns()
    del sites["reason"]
    with files.writing(out, ReplayError):
        rows = zip(*(column.tolist() for column in sites.values()), strict=True)
        files.write_csv(out / "sites.csv", sites, rows)
        files.write_csv(out / "selected.csv", TargetChange._fields, result.targets)
        files.write_npz(out / "cells.npz", cells_arrays(result.cells))
        files.write_npz(out / "grid.npz", grid_of(result.assessment))
        timings = ([*row[:-1], f"{row.map_ms:.4f}"] for row in result.timings)
        files.write_csv(out / "timing.csv", ScanTiming._fields, timings)
        files.write_npz(out / "history.npz", (history or History()).arrays(risk=report))
        files.write_bytes(out / "config.yaml", dump_config(config).encode())
        files.write_json(out / "summary.json", result.summary)
        _remove_report(out)
        if report:
            write_report(out)


def write_report(out: Path) -> None:
    from quadtree_lss.desk.report.report import report_files  # matplotlib takes long to import

    for name, content in report_files(out).items():
        files.write_bytes(out / name, content)


def _remove_report(out: Path) -> None:
    """Remove page, figures and evaluation of an earlier run."""
    folder = out / "evaluation"
    old = [out / "report.html", *(out / "figures" / f"{name}.png" for name in FIGURES)]
    old += [*folder.glob("fig[0-9][0-9]_*.png"), folder / "evaluation.json", folder / "report.html"]
    for path in old:
        path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # missing or not empty
        folder.rmdir()


def grid_of(assessment: LandingAssessment) -> Grid:
    names = "x y elevation plane_elevation slope_deg hazard safe score risk".split()
    layers = {name: getattr(assessment, name) for name in names}
    return Grid(layers, probability=known_probability(assessment))


def aligned(rows: Sequence[Sequence[str]], sides: str = "<>") -> list[str]:
    """Format a table as lines. ``sides``: alignment of each column, ``<`` or ``>``; the last one is
    repeated."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    sides = sides.ljust(len(widths), sides[-1])
    forms = [f"{{:{side}{width}}}" for side, width in zip(sides, widths, strict=True)]
    return ["  ".join(forms).format(*row).rstrip() for row in rows]


def points_line(points: int, dropped: Mapping[str, int]) -> str:
    """Format ``points 5.9 of 6.6 million used (10 % outside the domain)``. ``dropped``: counts by
    key of `lost_points.REASONS`."""
    used = points - sum(dropped.values())
    text = f"points {used} of {points} used"
    if points >= 1e6:
        two_digits = partial(np.format_float_positional, precision=2, fractional=False, trim="-")
        text = f"points {two_digits(1e-6 * used)} of {two_digits(1e-6 * points)} million used"
    counts = sorted(((n, reason) for reason, n in dropped.items() if n), reverse=True)
    lost = [f"{share_text(n, points)} {REASONS[key].partition(' (')[0]}" for n, key in counts]
    return f"{text} ({', '.join(lost)})" if lost else text


def points_warning(
    points: int,
    dropped: Mapping[str, int],
    domain: Domain,
    missed_at: tuple[float, float] | None = None,
) -> str | None:
    """Explain in one line why less than half of the points enter the map; None if more do.
    ``missed_at``: centre of a scan outside the domain, map frame, m."""
    used = points - sum(dropped.values())
    if not points or 2 * used >= points:
        return None
    share = f"only {share_text(used, points)}" if used else "none"
    text = f"{share} of {points} points can be used: {lost_points_text(dropped)}"
    if dropped.get("outside", 0):
        text += f"; {domain_text(domain)}"
        if missed_at is not None:
            text += f", the middle of the first scan that missed it is at x {missed_at[0]:.1f},"
            text += f" y {missed_at[1]:.1f}"
    return text


def share_text(part: int, total: int) -> str:
    """Format a share in %; 0 % and 100 % only if exact."""
    percent = 100.0 * part / total
    if 0.0 < percent < 0.1:
        return "< 0.1 %"
    if 99.9 < percent < 100.0:
        return "> 99.9 %"
    return f"{percent:.{1 if percent < 10.0 or 99.0 < percent < 100.0 else 0}f} %"
