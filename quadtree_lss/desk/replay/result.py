# SPDX-License-Identifier: Apache-2.0
"""What a replay produced."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quadtree_lss.desk.replay.passes import TargetChange
from quadtree_lss.desk.replay.results import ScanTiming, plain
from quadtree_lss.onboard.core.landing.probability import shown
from quadtree_lss.onboard.core.landing.sites import LandingAssessment
from quadtree_lss.onboard.core.tree.cell_map import CellMap

__all__ = ["ReplayResult", "shown"]


@dataclass(frozen=True, repr=False)
class ReplayResult:
    """What a replay produced.

    Attributes:
        out: Results folder, None if none was asked for.
        cells: The map, as decoded from its message.
        assessment: Landing sites on it.
        timings: One row per mapped scan; empty for a bag of maps.
        summary: Content of ``summary.json``.
        targets: Changes of the target, in their order.
        losses: What could not be read of the bag, one line each; empty if all was read.
        warnings: One line per kind of trouble with the messages, with how often it occurred.
        interrupted: True if it was stopped before the bag's end.
    """

    out: Path | None
    cells: CellMap
    assessment: LandingAssessment
    timings: tuple[ScanTiming, ...]
    summary: dict[str, Any]
    losses: tuple[str, ...]
    warnings: tuple[str, ...]
    interrupted: bool = False
    targets: tuple[TargetChange, ...] = ()

    def __repr__(self) -> str:
        part = ", interrupted" if self.interrupted else ""
        where = "" if self.out is None else f", in {self.out}"
        return f"<ReplayResult: {len(self.timings)} scans{part}{where}; {self.assessment}>"

    def as_dict(self) -> dict[str, Any]:
        """The summary with the ranked sites, in JSON's types."""
        sites = self.assessment.sites
        rows = [
            {
                "rank": k + 1,
                "position": sites.position[k].tolist(),
                "normal": sites.normal[k].tolist(),
                "score": sites.score[k],
                "probability": sites.probability[k],
                "slope_deg": sites.slope_deg[k],
                "roughness": sites.roughness[k],
                "hazard_distance": sites.hazard_distance[k],
                "subscale_height": sites.subscale_height[k],
                "id": int(sites.id[k]),
                "reason": sites.reasons[k],
            }
            for k in range(len(sites.score))
        ]
        out = None if self.out is None else str(self.out)
        content: dict[str, Any] = plain({"out": out, "sites": rows, **self.summary})
        return content
