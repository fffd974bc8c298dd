# SPDX-License-Identifier: Apache-2.0
"""The headline of the page: the result and its reliability, or why there is no site."""

from __future__ import annotations

import re
from collections.abc import Mapping
from datetime import datetime, timezone
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt

from quadtree_lss.desk.exchange.saved import Results
from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.core.landing.ranking import equal_up_to
from quadtree_lss.onboard.core.landing.result import shown
from quadtree_lss.onboard.messages.intake import noise_notice

#: Smallest probability of success at a good site.
GOOD_PROBABILITY = 0.99
#: Smallest share of allowed ground within a vehicle diameter of a good site.
MIN_ALLOWED_SHARE = 0.5
#: Levels of trust in a site.
LEVELS = {"good": "Good", "care": "With care", "none": "Not good enough"}


class Areas(NamedTuple):
    """Areas of classes of grid points, m²."""

    seen: float
    allowed: float
    unmapped: float


class NearestMiss(NamedTuple):
    """The grid point that is closest to being a site, and the limit that it misses."""

    x: float
    y: float
    why: str


def areas(content: Results, moment: Moment) -> Areas:
    """Areas that are estimated, allowed, and observed but not estimated."""
    x, y = (np.full(len(content.grid[name]), content.grid.spacing) for name in "xy")
    x[[0, -1]] *= 0.5  # the outer points are on the edge of the map
    y[[0, -1]] *= 0.5
    each = y[:, None] * x
    return Areas(*(float(each[part].sum()) for part in moment[:3]))


def nearest_miss(content: Results) -> NearestMiss | None:
    """Find the grid point with the lowest risk, or slope, among those with space for a zone; None
    if there are sites or no point has the space."""
    grid, lss = content.grid, content.config.lss
    room = grid.spacing * distance_transform_edt(np.pad(grid.seen, 1))[1:-1, 1:-1] >= content.zone
    word, values = "slope {:.1f}°, but a hazard within the zone", grid["slope_deg"]
    if content.probability is not None:
        word = f"risk {{:.2g}} %, the limit is {100.0 * lss.max_risk:.2g} %"
        values = 100.0 * grid["risk"]
    values = np.where(room, values, np.nan)
    if lss.assessment == "paper" or grid["safe"].any() or not np.isfinite(values).any():
        return None
    row, column = np.unravel_index(np.nanargmin(values), values.shape)
    why = word.format(values[row, column])
    return NearestMiss(float(grid["x"][column]), float(grid["y"][row]), why)


class Fact(NamedTuple):
    """A fact about the best site or the run; ``level``: a key of `LEVELS`, or empty."""

    name: str
    value: str
    level: str = ""


class Moment(NamedTuple):
    """An assessment: masks (ny, nx), positions (K, 2) or (K, 3) of the ranked sites, m, their
    probabilities (K,), NaN if not computed, and the target (2,), None without one."""

    seen: Mask
    allowed: Mask
    unmapped: Mask
    position: Array
    probability: Array
    target: Array | None


class Verdict(NamedTuple):
    """The result: a key of `LEVELS`, headline, details and facts."""

    level: str
    answer: str
    ground: str
    facts: list[Fact]


def last_moment(content: Results) -> Moment:
    """The last assessment."""
    grid, sites = content.grid, content.sites
    none = np.full(len(sites["x"]), np.nan)
    probability = np.asarray(sites.get("probability", none), np.float64)
    masks = grid.seen, grid["safe"], grid.unmapped
    id_, *target = (content.selected[name][-1:] for name in ("id", "x", "y"))
    place = np.concatenate(target).astype(np.float64) if id_.any() else None
    return Moment(*masks, content.positions, probability, place)


def allowed_around(content: Results, moment: Moment) -> Array:
    """Share (K,) of allowed grid points within a vehicle diameter of each site."""
    x, y, reach = content.grid.x, content.grid.y, content.config.vehicle.diameter
    found = np.zeros(len(moment.position))
    for k, (site_x, site_y) in enumerate(moment.position[:, :2]):
        columns = slice(*np.searchsorted(x, [site_x - reach, site_x + reach]))
        rows = slice(*np.searchsorted(y, [site_y - reach, site_y + reach]))
        near = np.hypot(x[columns] - site_x, (y[rows] - site_y)[:, None]) <= reach
        found[k] = np.mean(moment.allowed[rows, columns][near]) if near.any() else 0.0
    return found


def ratings(content: Results, moment: Moment | None = None) -> list[tuple[str, str]]:
    """Level of each site (a key of `LEVELS`) and the reasons against it, or an empty text.

    A site is good if its probability and the allowed share of the ground around it reach their
    limits and the risk model fits the case. ``moment``: by default the last assessment.
    """
    lss, warnings = content.config.lss, content.summary.get("doubts", ())
    reach, found, moment = content.config.vehicle.diameter, [], moment or last_moment(content)
    shares = allowed_around(content, moment)
    for probability, share in zip(moment.probability, shares, strict=True):
        level, against = _level(probability, lss.min_probability), []
        if level == "none":
            against = [f"a target needs {shown(lss.min_probability)}"]
        elif probability < GOOD_PROBABILITY:
            against = [f"that is less than {shown(GOOD_PROBABILITY)}"]
        if share < MIN_ALLOWED_SHARE:
            level = "none" if level == "none" else "care"
            near = f"the ground within {reach:.3g} m is allowed"
            against += [f"only {rounded(100.0 * share)} % of {near}"]
        if warnings:
            level = "none" if level == "none" else "care"
            against += ["its risk may be wrong (see the warnings)"]
        found.append((level, "; ".join(against)))
    return found


def _level(probability: float, least: float) -> str:
    """Level of a site by its probability, NaN if unknown; a target needs the ``least``."""
    if probability < least:
        return "none"
    return "good" if probability >= GOOD_PROBABILITY else "care"


def verdict(content: Results, moment: Moment | None = None) -> Verdict:
    """Summarise an assessment, by default the last one."""
    at_end, moment = moment is None, moment or last_moment(content)
    found, number = areas(content, moment), len(moment.position)
    percent = rounded(100.0 * found.allowed / (found.seen or 1.0))
    ground = f"Landing is allowed on {percent} % of the {rounded(found.seen)} m² observed"
    if found.allowed:
        ground += f": {rounded(found.allowed)} m²"
    if found.unmapped >= 0.5:
        ground += f"; {rounded(found.unmapped)} m² more are observed but not estimated"
    facts = _facts(content, moment)
    if not number:
        details = _details_without_site(content, ground) if at_end else f"{ground}."
        return Verdict("none", "No landing site.", details, facts)
    (level, against), best = ratings(content, moment)[0], float(moment.probability[0])
    of = f"site 1, the best of {number}," if number > 1 else "the only site"
    words = f"a touchdown at {of} succeeds with {shown(best)}"
    if np.isnan(best):
        words = f"the risk at {of} is not computed"
    answer = f"{LEVELS[level]}: {words}{', but ' + against if against else ''}."
    place = ", ".join(f"{n} {v:.2f}" for n, v in zip("xyz", moment.position[0], strict=False))
    why = ": " + re.sub(r"^probability [^:;]*[:;] ", "", content.reasons[0]) if at_end else ""
    details = f"Site 1 is at {place} m{why}. {ground}."
    if at_end and moment.target is not None and _target_site(content, moment) != 1:
        told = f"{content.summary['target_why']}"
        details += f" {told[:1].upper()}{told[1:]}."
    return Verdict(level, answer, details, facts)


def _target_site(content: Results, moment: Moment) -> int:
    """Rank of the site at the target; 0 if no site is there."""
    away = np.hypot(*(moment.position[:, :2] - moment.target).T)
    near = np.flatnonzero(away < 0.5 * content.config.vehicle.diameter)
    return int(near[0]) + 1 if len(near) else 0


def _facts(content: Results, moment: Moment) -> list[Fact]:
    lss, vehicle, summary = content.config.lss, content.config.vehicle, content.summary
    facts, warnings = [], summary.get("doubts", ())
    if len(moment.position):
        best, share = float(moment.probability[0]), float(allowed_around(content, moment)[0])
        success = "not computed" if np.isnan(best) else shown(best)
        near = f"{rounded(100.0 * share)} % within {vehicle.diameter:.3g} m"
        enough = "good" if share >= MIN_ALLOWED_SHARE else "care"
        facts = [
            Fact("success at site 1", success, _level(best, lss.min_probability)),
            Fact("allowed around site 1", near, enough),
        ]
    if "probability" in (lss.assessment, lss.ranking):
        bad = "may be wrong, see warnings", "care"
        facts.append(Fact("risk model", *(bad if warnings else ("fits", "good"))))
    spread = " × ".join(f"{s:.3g}" for s in dict.fromkeys(content.dispersion))
    facts.append(Fact("touchdown dispersion, 1 σ", f"{spread} m"))
    if moment.target is not None:
        (x, y), rank = moment.target, _target_site(content, moment)
        facts.append(Fact("target", f"site {rank}" if rank else f"x {x:.2f}, y {y:.2f}"))
    ratio, noise = summary.get("range_noise_ratio"), content.config.lidar.range_noise
    if ratio is not None:
        level = "" if noise_notice(ratio, content.config) is None else "care"
        measured = f"{noise * ratio:.3g} m, set to {noise:.3g} m"
        facts.append(Fact("range noise, 1 σ", measured, level))
    return facts


def rank_reasons(sites: Mapping[str, Array], wanted: bool = False) -> list[str]:
    """Explain the rank of each site (see ``landing.ranking``). ``wanted``: sites near a requested
    target rank first."""
    probability, clear = sites.get("probability"), sites["hazard_distance"]
    if probability is None or not len(clear) or np.isnan(probability).any():
        return ["lowest score"] * (len(clear) > 0) + ["higher score"] * (len(clear) - 1)
    risks = 1.0 - np.asarray(probability, np.float64)
    words = ["most probable"]
    if risks.min() < risks[0]:
        words = ["as probable as any" + ", most room" * bool(clear[0] >= max(clear))]
    for k in range(1, len(risks)):
        equal = risks[k] <= equal_up_to(risks[k - 1])
        if equal and clear[k] <= clear[k - 1]:
            words.append(f"as probable as {k}, less room")
        elif wanted:
            words.append("farther from the planned point")
        else:
            words.append(f"as probable as {k}" if equal else f"less probable than {k}")
    if wanted:
        words[0] = "near the planned point"
    return words


def rounded(value: float) -> str:
    """Format as a whole number, or with two digits if small."""
    return f"{value:,.0f}" if value >= 9.95 or not value else f"{value:.2g}"


def _details_without_site(content: Results, ground: str) -> str:
    """Explain why there is no site, and describe the nearest miss."""
    text = f"{content.summary['explanation']}".removeprefix("no safe site: ").rstrip(".")
    lines = [f"{text[:1].upper()}{text[1:]}"]
    lines += [ground] if content.grid.seen.any() else []
    if (miss := nearest_miss(content)) is not None:
        lines.append(f"Nearest miss at x {miss.x:.2f}, y {miss.y:.2f} m: {miss.why}")
    return ". ".join(lines) + "."


def when(content: Results) -> str:
    """Frame and time of the map."""
    frame = f"frame {content.config.frames.map}"
    stamp = content.summary.get("last_stamp_ns")
    if stamp is None:
        return frame
    moment = datetime.fromtimestamp(stamp / 1e9, tz=timezone.utc)
    return f"{frame} · {moment:%Y-%m-%d %H:%M:%S} UTC"
