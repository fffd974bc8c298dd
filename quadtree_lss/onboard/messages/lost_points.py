# SPDX-License-Identifier: Apache-2.0
"""Messages about points that did not enter the map."""

from __future__ import annotations

from collections.abc import Mapping

from quadtree_lss.onboard.core.mapping.mapper import ScanReport
from quadtree_lss.onboard.core.sensing.pose_buffer import seconds
from quadtree_lss.onboard.core.sensing.register import ABOVE, CONTRADICTION
from quadtree_lss.onboard.core.tree.domain import Domain

NO_POINTS_USED = "no_points_used"
"""Key of the warning with `unused_points_text`."""

MAP_OVERRULED = "map_overruled"
"""Key of the warning with `overruled_text`."""

REASONS = {
    "no_return": "without a return",
    "range": "out of range (lidar.min_range, lidar.max_range)",
    "edge": "at edges, between near and far (depth images)",
    "isolated": "isolated",
    "outside": "outside the domain",
    ABOVE: "of scans above the lidar (poses or mount upside down)",
    CONTRADICTION: "contradicting the map (their pose is farther off than it claims)",
}
"""Descriptions of the keys of ``ScanReport.dropped``."""


def misplaced(report: ScanReport) -> bool:
    """Return whether no point entered the map, mostly because of position or axes."""
    lost = report.dropped.get("outside", 0) + report.dropped.get(ABOVE, 0)
    return not report.points_used and lost > report.dropped.get(CONTRADICTION, 0)


def unused_points_text(report: ScanReport, domain: Domain) -> str | None:
    """Explain in one line why no point of a scan entered the map; None if one did."""
    if report.points_used:
        return None
    text = f"no point of scan {seconds(report.stamp_ns)} entered the map: "
    text += lost_points_text(report.dropped)
    if report.dropped["outside"]:
        text += f"; {domain_text(domain)}"
        if report.centre is not None:
            text += f", the scan's middle is at x {report.centre[0]:.1f}, y {report.centre[1]:.1f}"
    return f"{text}; run quadtree-lss doctor" if misplaced(report) else text


def overruled_text(report: ScanReport) -> str | None:
    """Report that the map was shifted to match rejected scans; None if it was not."""
    if not report.overruled:
        return None
    text = f"the map was moved to scan {seconds(report.stamp_ns)}, or begun anew"
    return f"{text}: the last scans contradicted it and agreed with each other"


def lost_points_text(lost: Mapping[str, int]) -> str:
    """Format counts by reason, the largest first: ``16384 outside the domain, 3 without a
    return``."""
    counts = sorted(((n, key) for key, n in lost.items() if n), reverse=True)
    return ", ".join(f"{n} {REASONS[key]}" for n, key in counts)


def domain_text(domain: Domain) -> str:
    x, y, size = domain.xmin, domain.ymin, domain.size
    bounds = f"x {x:g} ... {x + size:g}, y {y:g} ... {y + size:g} m"
    return f"the domain is {bounds} (domain.xmin, domain.ymin, domain.size)"
