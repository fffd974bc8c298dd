# SPDX-License-Identifier: Apache-2.0
"""The headline of the page: the result, how far to trust it, or why there is no site.

Ground is *allowed* by the risk at a grid point; an aim point has a *probability*.
"""

from __future__ import annotations

import re
from datetime import datetime, timezone
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt

from quadtree_lss.desk.exchange.saved import Results
from quadtree_lss.desk.report.palette import excluding, slope_limit
from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.core.landing.probability import shown
from quadtree_lss.onboard.core.landing.target import SETTLE_SHARE
from quadtree_lss.onboard.messages.intake import noise_notice

GOOD = 0.99
"""Least probability of a good aim: one landing in a hundred fails."""
LEVELS = {"good": "Good", "care": "With care", "none": "None is good enough"}
"""Levels of trust in the best aim."""


class Areas(NamedTuple):
    """Areas of the ground at the grid points, m²."""

    seen: float
    allowed: float
    unmapped: float


class Circle(NamedTuple):
    """The largest circle of observed ground without excluding hazards; ``limit`` ends it."""

    x: float
    y: float
    radius: float
    limit: str


class NearestMiss(NamedTuple):
    """The grid point that is nearest to being a site, and why it is not one."""

    x: float
    y: float
    why: str


def areas(content: Results) -> Areas:
    """Areas that are observed, allowed, and observed but not estimated."""
    x, y = (np.full(len(content.grid[name]), content.grid.spacing) for name in "xy")
    x[[0, -1]] *= 0.5  # the outer points are on the edge of the map
    y[[0, -1]] *= 0.5
    each = y[:, None] * x
    of = (content.grid.seen, content.grid["safe"], content.grid.unmapped)
    return Areas(*(float(each[part].sum()) for part in of))


def largest_circle(content: Results) -> Circle | None:
    """The largest clear circle; None if landing is allowed somewhere, or no ground is clear."""
    grid = content.grid
    hazardous = (grid["hazard"] & excluding(content.config.lss.assessment)) > 0
    clear = grid.seen & ~hazardous
    if grid["safe"].any() or not clear.any():
        return None
    room = _room(clear, grid.spacing)
    row, column = np.unravel_index(np.argmax(room), room.shape)
    radius = float(room[row, column])
    away = np.hypot(grid["x"] - grid["x"][column], (grid["y"] - grid["y"][row])[:, None])
    edge = ~clear & (away < radius + 1.5 * grid.spacing)
    unseen, blocked = np.count_nonzero(edge & ~grid.seen), np.count_nonzero(edge & hazardous)
    limit = "hazards" if blocked > unseen else "unseen ground" if unseen else "the map's edge"
    if unseen >= blocked and 2 * np.count_nonzero(edge & grid.unmapped) > unseen:
        limit = "ground not yet mapped"
    return Circle(float(grid["x"][column]), float(grid["y"][row]), radius, limit)


def nearest_miss(content: Results) -> NearestMiss | None:
    """The most probable, else the most level grid point with room for a zone; None if none."""
    grid, lss = content.grid, content.config.lss
    room = _room(grid.seen, grid.spacing) >= content.zone
    best, word = np.nanargmin, "slope {:.1f} deg, but a hazard within the zone"
    values = grid["slope_deg"]
    if content.probability is not None:
        best, word = np.nanargmax, "probability {:.0f} %"
        values = 100.0 * content.probability
    values = np.where(room, values, np.nan)
    if lss.assessment == "paper" or grid["safe"].any() or not np.isfinite(values).any():
        return None
    row, column = np.unravel_index(best(values), values.shape)
    why = word.format(values[row, column])
    return NearestMiss(float(grid["x"][column]), float(grid["y"][row]), why)


def _room(mask: Mask, spacing: float) -> Array:
    """Distance (ny, nx) of grid points to the nearest one outside the mask, m."""
    room: Array = spacing * distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    return room


class Fact(NamedTuple):
    """A fact for the level of trust; ``level``: a key of `LEVELS`, or empty."""

    name: str
    value: str
    level: str = ""


def best_probability(content: Results) -> float:
    """Probability of the best aim; NaN without a site or if not computed."""
    found = content.sites.get("probability", np.zeros(0))
    return float(found[0]) if len(found) else float("nan")


def trust(content: Results) -> tuple[str, list[Fact]]:
    """A key of `LEVELS` for the best aim, and the facts behind it."""
    lss, summary, best = content.config.lss, content.summary, best_probability(content)
    doubts = list(summary.get("doubts", ()))
    level = "none" if best < lss.min_probability else "good" if best >= GOOD else "care"
    aim = f"{shown(best)}: {LEVELS[level].lower()}"
    if np.isnan(best):
        level, aim = "care", "not computed"
    if not len(content.sites["x"]):
        level, aim = "none", "there is none"
    fits = not doubts and lss.ranking == "probability"
    within = "yes" if fits else "no risk is computed"
    if doubts:
        within = f"no: {len(doubts)} in the warnings"
    noise, ratio = content.config.lidar.range_noise, summary.get("range_noise_ratio")
    noisy = ratio is not None and noise_notice(ratio, content.config) is not None
    seen, cells = float(np.mean(content.grid.seen)), content.config.domain
    finest, coarsest = (cells.size / 2.0**k for k in (cells.max_level, cells.min_level))
    facts = [
        Fact("best aim", aim, level),
        Fact("within the fit", within, "good" if fits else "care"),
        Fact("cells", f"{finest:.3g} to {coarsest:.3g} m"),
        Fact(
            "range noise, seen / set",
            f"{'–' if ratio is None else format(noise * ratio, '.3g')} / {noise:.3g} m",
            "care" if noisy else "",
        ),
        Fact("area seen", f"{100.0 * seen:.0f} %", "care" if seen < SETTLE_SHARE else ""),
        Fact("dispersion, 1 σ", " × ".join(f"{s:.3g}" for s in content.dispersion) + " m"),
    ]
    if lss.assessment == "probability":
        facts.append(Fact("risk allowed at a place", f"{100.0 * lss.max_risk:.3g} %"))
    return "care" if level == "good" and not fits else level, facts


def headline(content: Results) -> tuple[str, str]:
    """The result in few words, and details."""
    found, sites = areas(content), content.sites
    percent = few(100.0 * found.allowed / (found.seen or 1.0))
    ground = f"Landing is allowed on {percent} % of the {few(found.seen)} m² seen"
    if found.allowed:
        ground += f": {few(found.allowed)} m²"
    if found.unmapped >= 0.5:
        ground += f"; {few(found.unmapped)} m² more are seen, not yet mapped"
    number, best = len(sites["x"]), best_probability(content)
    if not number:
        return "No landing site.", _without(content, ground)
    of = f"the best of {number} sites" if number > 1 else "the one site"
    level, words = trust(content)[0], f"no probability is computed of {of}"
    if np.isfinite(best):
        words = f"{shown(best)} at {of}"
        if level == "none":
            words += f", and a target needs {shown(content.config.lss.min_probability)}"
    x, y, z = (f"{sites[name][0]:.2f}" for name in "xyz")
    why = re.sub(r"^probability [^:]*: ", "", content.reasons[0])
    place = f"At x {x}, y {y}, z {z} m. {why[:1].upper()}{why[1:]}. {ground}."
    return f"{LEVELS[level]}: {words}.", place


def few(value: float) -> str:
    """Format a whole number, or two digits of a small one."""
    return f"{value:,.0f}" if value >= 9.95 or not value else f"{value:.2g}"


def shortfall(content: Results) -> str:
    """Without a site, the limit that is missed and by how much; or empty."""
    lss, need = content.config.lss, content.zone
    if content.grid["safe"].any() or not content.grid.seen.any():
        return ""
    room = _room(content.grid.seen, content.grid.spacing)
    if room.max() < need:
        short = need - float(room.max())
        return f"The widest seen ground is {short:.2f} m short of the {need:.2f} m radius of a zone"
    fits = room >= need
    risk = content.grid.get("risk")
    if lss.assessment == "probability" and risk is not None:
        least = float(np.nanmin(risk[fits], initial=1.0))
        if least > lss.max_risk:
            times = ", not the"
            if lss.max_risk:
                times = f", {least / lss.max_risk:.3g} times the allowed"
            limit = f"{100.0 * lss.max_risk:.3g} % (lss.max_risk)"
            return f"The lowest risk of a place is {100.0 * least:.2g} %{times} {limit}"
    slope = float(np.nanmin(content.grid["slope_deg"][fits], initial=90.0))
    limit_deg = slope_limit(lss)
    if slope > limit_deg:
        over = f"{slope - limit_deg:.1f} deg over the limit of {limit_deg:.1f} deg"
        return f"The most level place has {slope:.1f} deg, {over}"
    circle = largest_circle(content)
    if circle is None or circle.radius >= need:
        return ""
    short = need - circle.radius
    return f"Clear ground is {short:.2f} m short of the {need:.2f} m radius of a zone"


def _without(content: Results, ground: str) -> str:
    """Details without a site: the missed limit, the nearest miss, the largest circle."""
    text = f"{content.summary['explanation']}".removeprefix("no safe site: ").rstrip(".")
    lines = [shortfall(content) or f"{text[:1].upper()}{text[1:]}"]
    lines += [ground] if content.grid.seen.any() else []
    miss, circle = nearest_miss(content), largest_circle(content)
    if miss is not None:
        lines.append(f"Nearest miss at x {miss.x:.2f}, y {miss.y:.2f} m: {miss.why}")
    if circle is not None:
        text = f"Largest circle of clear ground: {circle.radius:.2f} m about x {circle.x:.2f},"
        text += f" y {circle.y:.2f} m, up to {circle.limit}; {content.zone:.2f} m are needed"
        lines.append(text)
    return ". ".join(lines) + "."


def when(content: Results) -> str:
    """Frame and date of the map."""
    frame = f"frame {content.config.frames.map}"
    stamp = content.summary.get("last_stamp_ns")
    if stamp is None:
        return frame
    moment = datetime.fromtimestamp(stamp / 1e9, tz=timezone.utc)
    return f"{frame} · {moment:%Y-%m-%d %H:%M:%S} UTC"
