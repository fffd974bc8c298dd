# SPDX-License-Identifier: Apache-2.0
"""What a replay produced, and the key figures of the run."""

from __future__ import annotations

import platform
import resource
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import quadtree_lss
from quadtree_lss import build
from quadtree_lss.desk.replay.files import plain
from quadtree_lss.desk.replay.passes import TargetChange
from quadtree_lss.onboard.config.settings import Config, values_from_config
from quadtree_lss.onboard.core.landing.sites import LandingAssessment
from quadtree_lss.onboard.core.tree.cell_map import CellMap


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
    """What a replay produced; ``out`` is None if nothing was written.

    ``cells`` are as decoded from their message, ``timings`` a row per mapped scan, empty for a bag
    of maps, ``summary`` the content of ``summary.json``; ``targets`` are the changes of the target.
    """

    out: Path | None
    cells: CellMap
    assessment: LandingAssessment
    timings: tuple[ScanTiming, ...]
    summary: dict[str, Any]
    targets: tuple[TargetChange, ...] = ()

    @property
    def losses(self) -> tuple[str, ...]:
        """What could not be read of the bag, a line each."""
        return tuple(self.summary["losses"])

    @property
    def warnings(self) -> tuple[str, ...]:
        """Each kind of trouble with the messages and how often it occurred, a line each."""
        return tuple(self.summary["warnings"])

    @property
    def interrupted(self) -> bool:
        """It was stopped before the bag's end."""
        return bool(self.summary["interrupted"])

    def __repr__(self) -> str:
        part = ", interrupted" if self.interrupted else ""
        where = "" if self.out is None else f", in {self.out}"
        return f"<ReplayResult: {len(self.timings)} scans{part}{where}; {self.assessment}>"

    def as_dict(self) -> dict[str, Any]:
        """The summary with the ranked sites, in JSON's types."""
        sites = self.assessment.sites
        names = ("normal", "score", "probability", "slope_deg", "roughness", "hazard_distance")
        rows = [
            {
                "rank": k + 1,
                "position": sites.position[k].tolist(),
                **{name: np.asarray(getattr(sites, name)[k]).tolist() for name in names},
                "subscale_height": sites.subscale_height[k],
                "id": int(sites.id[k]),
                "reason": sites.reasons[k],
            }
            for k in range(len(sites.score))
        ]
        out = None if self.out is None else str(self.out)
        content: dict[str, Any] = plain({"out": out, "sites": rows, **self.summary})
        return content


def run_summary(
    cells: CellMap,
    found: LandingAssessment,
    config: Config,
    lss_ms: float = float("nan"),
    timings: Sequence[ScanTiming] = (),
    **known: Any,
) -> dict[str, Any]:
    """Content of ``summary.json`` of a run: ``known`` stands over what holds for a map that is of
    no bag. Times in ms; without a scan those of a map update are NaN."""
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
        "peak_memory_mb": peak_memory_mb(),
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
        "target_changes": int(found.selected.id > 0),
        "explanation": found.explanation,
        "doubts": found.doubts,
        "reasons": found.sites.reasons,
        "interrupted": False,
        "losses": (),
        "warnings": found.doubts,
        **known,
    }


def peak_memory_mb() -> float:
    """Largest resident size of this process so far, MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e6 / 1024.0)


def versions() -> dict[str, str]:
    """Versions of this package and of what its numbers depend on."""
    found = {"quadtree_lss": quadtree_lss.__version__, "build": build.name()}
    found["python"] = platform.python_version()
    for name in ("numpy", "scipy", "rosbags"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found
