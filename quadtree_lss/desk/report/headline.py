# SPDX-License-Identifier: Apache-2.0
"""What was found in a sentence: where to land and how sure that is, or what stands in the way."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timezone

import numpy as np
from scipy.ndimage import distance_transform_edt

from quadtree_lss.desk.report.content import Content
from quadtree_lss.desk.report.palette import excluding
from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.core.landing.probability import shown


@dataclass(frozen=True)
class Areas:
    """Of the ground at the grid points, m²."""

    seen: float
    safe: float
    unmapped: float

    @property
    def share(self) -> float:
        """Of the seen ground that is safe."""
        return self.safe / self.seen if self.seen else 0.0


@dataclass(frozen=True)
class Circle:
    """The largest of seen ground without a hazard that excludes; ``limit`` is what it ends at."""

    x: float
    y: float
    radius: float
    limit: str


@dataclass(frozen=True)
class NearestMiss:
    """The place that comes nearest to a site, and why it is none."""

    x: float
    y: float
    why: str


def areas(content: Content) -> Areas:
    """How much is seen, how much of it is safe, and how much more is seen but not yet mapped."""
    x, y = (np.gradient(content.grid[name]) for name in "xy")
    x[[0, -1]] *= 0.5  # the outer points stand at the map's edge
    y[[0, -1]] *= 0.5
    each = y[:, None] * x
    of = (content.seen, content.grid["safe"], content.unmapped)
    return Areas(*(float(each[part].sum()) for part in of))


def largest_circle(content: Content) -> Circle | None:
    """None if there is safe ground, or none that is seen and clear."""
    grid = content.grid
    hazardous = (grid["hazard"] & excluding(content.config.lss.assessment)) > 0
    clear = content.seen & ~hazardous
    if grid["safe"].any() or not clear.any():
        return None
    room = _room(clear, content.spacing)
    row, column = np.unravel_index(np.argmax(room), room.shape)
    radius = float(room[row, column])
    away = np.hypot(grid["x"] - grid["x"][column], (grid["y"] - grid["y"][row])[:, None])
    edge = ~clear & (away < radius + 1.5 * content.spacing)
    unseen, blocked = np.count_nonzero(edge & ~content.seen), np.count_nonzero(edge & hazardous)
    limit = "hazards" if blocked > unseen else "unseen ground" if unseen else "the map's edge"
    if unseen >= blocked and 2 * np.count_nonzero(edge & content.unmapped) > unseen:
        limit = "ground not yet mapped"
    return Circle(float(grid["x"][column]), float(grid["y"][row]), radius, limit)


def nearest_miss(content: Content) -> NearestMiss | None:
    """The likeliest place, else the most level one of those with room; None if there is none."""
    grid, lss = content.grid, content.config.lss
    room = _room(content.seen, content.spacing) >= content.zone
    values, word = content.probability, "probability {:.0%}"
    best = np.nanargmax if values is not None else np.nanargmin
    if values is None:
        values, word = grid["slope_deg"], "slope {:.1f} deg, but a hazard within the zone"
    values = np.where(room, values, np.nan)
    if lss.assessment == "paper" or grid["safe"].any() or not np.isfinite(values).any():
        return None
    row, column = np.unravel_index(best(values), values.shape)
    why = word.format(values[row, column])
    return NearestMiss(float(grid["x"][column]), float(grid["y"][row]), why)


def _room(mask: Mask, spacing: float) -> Array:
    """Distance (ny, nx) of grid points to where the mask is not, m."""
    room: Array = spacing * distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    return room


def headline(content: Content) -> tuple[str, str]:
    """The answer in few words, and what it rests on."""
    found, sites = areas(content), content.sites
    ground = f"{100.0 * found.share:.0f} % of the {found.seen:,.0f} m² seen is safe"
    if found.safe:
        ground += f": {found.safe:,.0f} m²"
    if found.unmapped >= 0.5:
        ground += f"; {found.unmapped:,.0f} m² more are seen, not yet mapped"
    number = len(sites["x"])
    if not number:
        return "No safe site.", _without(content, ground)
    x, y, z = (f"{sites[name][0]:.2f}" for name in "xyz")
    best = f"{number} landing sites" if number > 1 else "One landing site"
    text = f"Best at x {x}, y {y}, z {z} m"
    probability = sites.get("probability")
    told = content.reasons[0].startswith("probability ")
    if probability is not None and np.isfinite(probability[0]) and not told:
        text += f", probability {shown(probability[0])}"
    return f"{best}.", f"{text}: {content.reasons[0]}. {ground}."


def _without(content: Content, ground: str) -> str:
    """What limits, said once, then the nearest miss and the largest circle."""
    text = f"{content.summary['explanation']}".removeprefix("no safe site: ").rstrip(".")
    lines = [f"{text[:1].upper()}{text[1:]}", *([ground] if content.seen.any() else ())]
    miss, circle = nearest_miss(content), largest_circle(content)
    if miss is not None:
        lines.append(f"Nearest miss at x {miss.x:.2f}, y {miss.y:.2f} m: {miss.why}")
    if circle is not None:
        lines.append(
            f"Largest circle of clear ground: {circle.radius:.2f} m about x {circle.x:.2f},"
            f" y {circle.y:.2f} m, up to {circle.limit}; {content.zone:.2f} m are needed"
        )
    return ". ".join(lines) + "."


def when(content: Content) -> str:
    """Frame and date of the map."""
    frame = f"frame {content.config.frames.map}"
    stamp = content.summary.get("last_stamp_ns")
    if stamp is None:
        return frame
    moment = datetime.fromtimestamp(stamp / 1e9, tz=timezone.utc)
    return f"{frame} · {moment:%Y-%m-%d %H:%M:%S} UTC"
