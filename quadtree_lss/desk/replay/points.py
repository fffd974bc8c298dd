# SPDX-License-Identifier: Apache-2.0
"""What became of the points of a run: how many entered the map, and why the others did not."""

from __future__ import annotations

from collections.abc import Mapping

from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.messages.lost_points import REASONS, domain_text, lost_points_text


def points_line(points: int, dropped: Mapping[str, int]) -> str:
    """``points 5.9 of 6.6 million used (10 % outside the domain)``. ``points``: of all mapped
    scans. ``dropped``: those of them that are not in the map, by the keys of
    `lost_points.REASONS`."""
    used = points - sum(dropped.values())
    text = f"points {used} of {points} used"
    if points >= 1e6:
        text = f"points {_significant(used)} of {_significant(points)} million used"
    told = sorted(((n, reason) for reason, n in dropped.items() if n), reverse=True)
    lost = [f"{share_text(n, points)} {REASONS[key].partition(' (')[0]}" for n, key in told]
    return f"{text} ({', '.join(lost)})" if lost else text


def points_warning(
    points: int,
    dropped: Mapping[str, int],
    domain: Domain,
    missed_at: tuple[float, float] | None = None,
    why: str = "",
) -> str | None:
    """Why less than half of the points enter the map, in one line; None if more do.

    Args:
        points, dropped: As for `points_line`.
        domain: Is named, with its place, when points missed it.
        missed_at: Middle of a scan that missed it, x and y in the map frame, m.
        why: Of `lost_points.likely_reason` for that scan.
    """
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
    return f"{text}; {why}" if why else text


def share_text(part: int, of: int) -> str:
    """Per cent: not 0 % of a few, not 100 % of nearly all."""
    percent = 100.0 * part / of
    if 0.0 < percent < 0.1:
        return "< 0.1 %"
    if 99.9 < percent < 100.0:
        return "> 99.9 %"
    return f"{percent:.{1 if percent < 10.0 or 99.0 < percent < 100.0 else 0}f} %"


def _significant(number: int) -> str:
    """Millions, to a tenth or to two digits."""
    return f"{1e-6 * number:.1f}" if number >= 1e6 or not number else f"{1e-6 * number:.2g}"
