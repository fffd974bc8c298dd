# SPDX-License-Identifier: Apache-2.0
"""Messages about points that did not enter the map, and their likely cause."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from quadtree_lss.onboard.arrays import Array, Points
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.mapping.mapper import ScanReport
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.mount import AXES
from quadtree_lss.onboard.core.sensing.pose_buffer import seconds
from quadtree_lss.onboard.core.tree.domain import Domain

TRIED_POINTS = 500
"""Number of points of a scan that are tried with other axes and frames."""

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
    "above": "of scans above the lidar (poses or mount upside down)",
    "contradiction": "contradicting the map (their pose is farther off than it claims)",
}
"""Descriptions of the keys of ``ScanReport.dropped``."""


def misplaced(report: ScanReport) -> bool:
    """Return whether no point entered the map, mostly because of position or axes."""
    lost = report.dropped.get("outside", 0) + report.dropped.get("above", 0)
    return not report.points_used and lost > report.dropped.get("contradiction", 0)


def unused_points_text(report: ScanReport, domain: Domain, why: str = "") -> str | None:
    """Explain in one line why no point of a scan entered the map; None if one did. ``why``: from
    `likely_reason`."""
    if report.points_used:
        return None
    text = f"no point of scan {seconds(report.stamp_ns)} entered the map: "
    text += lost_points_text(report.dropped)
    if report.dropped["outside"]:
        text += f"; {domain_text(domain)}"
        if report.centre is not None:
            text += f", the scan's middle is at x {report.centre[0]:.1f}, y {report.centre[1]:.1f}"
    return f"{text}; {why}" if why else text


def overruled_text(report: ScanReport) -> str | None:
    """Report that the map was shifted to match rejected scans; None if it was not."""
    if not report.overruled:
        return None
    return (
        f"the map was moved to scan {seconds(report.stamp_ns)}, or begun anew: the last scans"
        " contradicted it and agreed with each other"
    )


def lost_points_text(lost: Mapping[str, int]) -> str:
    """Format counts by reason, the largest first: ``16384 outside the domain, 3 without a
    return``."""
    counts = sorted(((n, key) for key, n in lost.items() if n), reverse=True)
    return ", ".join(f"{n} {REASONS[key]}" for n, key in counts)


def domain_text(domain: Domain) -> str:
    x, y, size = domain.xmin, domain.ymin, domain.size
    return (
        f"the domain is x {x:g} ... {x + size:g}, y {y:g} ... {y + size:g} m"
        " (domain.xmin, domain.ymin, domain.size)"
    )


NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])


def likely_reason(points_lidar: Points, pose: Pose, config: Config) -> str:
    """Find the error of axes or frames that explains why a scan is outside or above the lidar.

    Each common error is corrected on some of the points; the text describes the one with most
    points inside the domain and below the lidar, if at least half. ``points_lidar``: (..., 3), m.
    ``pose``: of the cloud's axes (``mount.axes``).
    """
    points = points_lidar.reshape(-1, 3).astype(np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    points = points[:: max(len(points) // TRIED_POINTS, 1)]
    if not len(points):
        return ""
    p, r = pose.position, pose.rotation_map_lidar
    own = r @ AXES[config.mount.axes].T
    corrections = [
        (f"mount.axes: {name}", own @ turn, p)
        for name, turn in AXES.items()
        if name != config.mount.axes
    ]
    corrections += [
        ("poses whose orientation rotates lidar axes to map axes", r.T, p),
        ("the pose of a body with z up and a lidar that looks down from it: mount.roll_deg 180",
         own @ LOOKING_DOWN, p),
        ("a cloud in the lidar's axes: this one is in the map's frame already",
         np.eye(3), np.zeros(3)),
    ]  # fmt: skip
    north = ("poses with x east, y north, z up instead of north, east, down",
             NED_FROM_ENU @ r, NED_FROM_ENU @ p)  # fmt: skip
    corrections.insert(0 if p[2] < 0.0 else len(corrections), north)
    shares = [
        _share_inside(points @ turn.T + origin, config, origin if origin.any() else p)
        for _, turn, origin in corrections
    ]
    best = int(np.argmax(shares))
    if shares[best] < 0.5:
        return ""
    share = f"{100 * shares[best]:.0f} % of its points"
    return f"it would lie inside, below the lidar, with {corrections[best][0]} ({share})"


def _share_inside(points_map: Array, config: Config, lidar: Array) -> float:
    """Return the share of points in the domain (which may follow the lidar) and below the lidar."""
    d = config.domain
    west, south = d.xmin, d.ymin
    if d.follow == "vehicle":
        west, south = lidar[:2] - 0.5 * d.size
    x, y, z = points_map.T
    inside = (x >= west) & (x < west + d.size) & (y >= south) & (y < south + d.size)
    return float(np.mean(inside & (z < lidar[2])))
