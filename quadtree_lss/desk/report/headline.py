# SPDX-License-Identifier: Apache-2.0
"""The headline of the page: the result and its reliability, or why there is no site."""

from __future__ import annotations

from datetime import datetime, timezone
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt

from quadtree_lss.desk.exchange.saved import Results
from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.core.landing.ranking import equal_up_to
from quadtree_lss.onboard.core.landing.raster import DISTANCE_CAP
from quadtree_lss.onboard.core.landing.result import shown
from quadtree_lss.onboard.messages.intake import noise_notice

#: Smallest probability of success at a good site.
GOOD_PROBABILITY = 0.99
#: Smallest share of allowed ground within a vehicle diameter of a good site.
MIN_ALLOWED_SHARE = 0.5
#: Stamps before the year 2000 are times since the start, as in simulations, ns.
FIRST_DATE_NS = 946_684_800 * 10**9
#: Levels of trust in a site.
LEVELS = {"good": "Good", "care": "With care", "none": "Not good enough"}


def areas(content: Results, moment: Moment) -> list[float]:
    """Areas that are estimated, allowed, and observed but not estimated, m²."""
    x, y = (np.full(len(content.grid[name]), content.grid.spacing) for name in "xy")
    x[[0, -1]] *= 0.5  # the outer points are on the edge of the map
    y[[0, -1]] *= 0.5
    each = y[:, None] * x
    return [float(each[part].sum()) for part in moment[:3]]


def nearest_miss(content: Results) -> dict[str, Any] | None:
    """Find the grid point with the lowest risk, or slope, among those with space for a zone: ``x``,
    ``y``, and ``why`` it is no site; None if there are sites or no point has the space."""
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
    return {"x": float(grid["x"][column]), "y": float(grid["y"][row]), "why": why}


class Fact(NamedTuple):
    """A fact about the best site or the run; ``level``: a key of `LEVELS`, or empty."""

    name: str
    value: str
    level: str = ""


class Moment(NamedTuple):
    """An assessment: masks (ny, nx), positions (K, 3) of the ranked sites, m, and their
    probabilities (K,), NaN if not computed. ``targets``: (A, 5) number, position and probability of
    this assessment's target and of the ones before, number 0 without one. ``why`` it is the target,
    or there is none; ``reason`` of the target or of site 1, empty if unknown."""

    seen: Mask
    allowed: Mask
    unmapped: Mask
    position: Array
    probability: Array
    targets: Array
    why: str
    reason: str = ""

    @property
    def target(self) -> Array | None:
        """The last row of ``targets``, None without a target."""
        return self.targets[-1] if self.targets[-1:, 0].any() else None

    @property
    def place(self) -> tuple[str, Array, float]:
        """Name, position and probability of the target, or without one of site 1."""
        if self.target is None:
            return "site 1", self.position[0], float(self.probability[0])
        return "the target", self.target[1:4], float(self.target[4])


class Verdict(NamedTuple):
    """The result: a key of `LEVELS`, headline, details and facts."""

    level: str
    answer: str
    ground: str
    facts: list[Fact]


def last_moment(content: Results) -> Moment:
    """The last assessment."""
    grid, sites, summary = content.grid, content.sites, content.summary
    none = np.full(len(sites["x"]), np.nan)
    probability = np.asarray(sites.get("probability", none), np.float64)
    targets = content.history.get("target", ())
    if not len(targets):
        targets = np.column_stack([content.selected[k] for k in "id x y z probability".split()])
    reason = summary["target_reason"] if targets[-1:, 0].any() else "".join(content.reasons[:1])
    masks = grid.seen, grid["safe"], grid.unmapped
    return Moment(*masks, content.positions, probability, targets, summary["target_why"], reason)


def past_moment(content: Results, answer: int, seen: Mask, allowed: Mask) -> Moment:
    """An assessment of the history by its number, with its masks."""
    history, own = content.history, content.history["site_answer"] == answer
    sites = history["site_position"][own], history["site_probability"][own]
    targets, why = history["target"][: answer + 1], str(history["target_why"][answer])
    return Moment(seen, allowed, np.zeros_like(seen), *sites, targets, why)


def allowed_share(content: Results, moment: Moment, place: Array) -> float:
    """Share of allowed grid points within a vehicle diameter of a place."""
    x, y, reach = content.grid.x, content.grid.y, content.config.vehicle.diameter
    columns = slice(*np.searchsorted(x, [place[0] - reach, place[0] + reach]))
    rows = slice(*np.searchsorted(y, [place[1] - reach, place[1] + reach]))
    near = np.hypot(x[columns] - place[0], (y[rows] - place[1])[:, None]) <= reach
    return float(np.mean(moment.allowed[rows, columns][near])) if near.any() else 0.0


def ratings(content: Results) -> list[tuple[str, str]]:
    """Rating of each site of the last assessment (see `rating`)."""
    moment = last_moment(content)
    sites = zip(moment.position, moment.probability, strict=True)
    return [rating(content, moment, place, probability) for place, probability in sites]


def rating(content: Results, moment: Moment, place: Array, probability: float) -> tuple[str, str]:
    """Level of a place (a key of `LEVELS`) and the reasons against it, or an empty text.

    It is good if its probability and the allowed share of the ground around it reach their limits
    and the risk model fits the case.
    """
    least, reach = content.config.lss.min_probability, content.config.vehicle.diameter
    share, against = allowed_share(content, moment, place), []
    level = _level(probability, least)
    if level == "none":
        against = [f"a target needs {shown(least)}"]
    elif probability < GOOD_PROBABILITY:
        against = [f"a good site needs {shown(GOOD_PROBABILITY)}"]
    if share < MIN_ALLOWED_SHARE:
        near = f"the ground within {reach:.3g} m is allowed"
        against += [f"only {rounded(100.0 * share)} % of {near}"]
    if content.summary.get("doubts"):
        against += ["the risk model does not fit this case (see below)"]
    return "care" if level == "good" and against else level, "; ".join(against)


def _level(probability: float, least: float) -> str:
    """Level of a site by its probability, NaN if unknown; a target needs the ``least``."""
    if probability < least:
        return "none"
    return "good" if probability >= GOOD_PROBABILITY else "care"


def verdict(content: Results, moment: Moment | None = None) -> Verdict:
    """Summarise an assessment, by default the last one."""
    at_end, moment = moment is None, moment or last_moment(content)
    (seen, allowed, unmapped), number = areas(content, moment), len(moment.position)
    percent = rounded(100.0 * allowed / (seen or 1.0))
    ground = f"Landing is allowed on {percent} % of the {rounded(seen)} m² observed"
    if allowed:
        ground += f": {rounded(allowed)} m²"
    if unmapped >= 0.5:
        ground += f"; {rounded(unmapped)} m² more are observed but not estimated"
    facts, target = _facts(content, moment), moment.target
    if not number and target is None:
        details = _details_without_site(content, ground) if at_end else f"{ground}."
        return Verdict("none", "No landing site.", details, facts)
    _, position, probability = moment.place
    level, against = rating(content, moment, position, probability)
    where = ", ".join(f"{n} {v:.2f}" for n, v in zip("xyz", position, strict=False)) + " m"
    success = "is not computed" if np.isnan(probability) else f"is {shown(probability)}"
    if target is not None:
        act = "the target is" if level == "none" else "land"
        answer = f"{act} at {where}; the probability of a safe touchdown there {success}"
    else:
        level = "care" if level == "good" else level
        place = f"site 1 of {number}, {where},"
        answer = f"{moment.why}; the probability of a safe touchdown at {place} {success}"
    answer = f"{LEVELS[level]}: {answer}{', but ' + against if against else ''}."
    *risk, surface = moment.reason.removeprefix(f"probability {shown(probability)}; ").split("; ")
    details = [] if target is None else [_relation(content, moment, at_end)]
    details += [f"Against it: {'; '.join(risk)}"] if risk else []
    details += [f"Ground: {surface}"] if surface else []
    return Verdict(level, answer, ". ".join([*details, ground]) + ".", facts)


def _relation(content: Results, moment: Moment, at_end: bool) -> str:
    """Relation of the target to the ranked sites, and why it is the target."""
    why, (number, x, y, *_) = moment.why.partition(": ")[2], moment.targets[-1]
    name = f"It is target {number:.0f}"
    if len(moment.targets) > 1 and (moment.targets[-2:-1, :3] == (number, x, y)).all():
        name += ", held from an earlier assessment"
    if not (count := len(moment.position)):
        return f"{name}, and no site is ranked: {why}"
    away = np.hypot(moment.position[:, 0] - x, moment.position[:, 1] - y)
    k = int(np.argmin(away))
    if away[k] >= 0.01:
        return f"{name}, {away[k]:.1f} m from site {k + 1} of {count}: {why}"
    if at_end:
        why = f"{rank_reasons(content)[k].replace('equal to ', 'as probable as site ')}; {why}"
    return f"It is site {k + 1} of {count}: {why}"


def _facts(content: Results, moment: Moment) -> list[Fact]:
    lss, vehicle, summary = content.config.lss, content.config.vehicle, content.summary
    facts, warnings = [], summary.get("doubts", ())
    if moment.target is not None or len(moment.position):
        name, position, best = moment.place
        share = allowed_share(content, moment, position)
        success = "not computed" if np.isnan(best) else shown(best)
        near = f"{rounded(100.0 * share)} % within {vehicle.diameter:.3g} m"
        enough = "good" if share >= MIN_ALLOWED_SHARE else "care"
        facts = [
            Fact(f"success at {name}", success, _level(best, lss.min_probability)),
            Fact(f"allowed around {name}", near, enough),
        ]
    if "probability" in (lss.assessment, lss.ranking):
        bad = "does not fit, see below", "care"
        facts.append(Fact("risk model", *(bad if warnings else ("fits", "good"))))
    spread = " × ".join(f"{s:.3g}" for s in dict.fromkeys(content.dispersion))
    facts.append(Fact("touchdown dispersion, 1 σ", f"{spread} m"))
    size = f"{vehicle.diameter:.3g} m, clearance {vehicle.clearance:.3g} m"
    facts.append(Fact("vehicle, diameter", size))
    ratio, noise = summary.get("range_noise_ratio"), content.config.lidar.range_noise
    if ratio is not None:
        level = "" if noise_notice(ratio, content.config) is None else "care"
        measured = f"{noise * ratio:.3g} m, set to {noise:.3g} m"
        facts.append(Fact("range noise, 1 σ", measured, level))
    return facts


def enough_room(content: Results) -> float:
    """Room beyond which more does not count (see ``landing.ranking``), m."""
    return DISTANCE_CAP * content.config.lss.vehicle.diameter_ratio - content.zone


def rank_reasons(content: Results) -> list[str]:
    """Explain the rank of each site by the shown figures (see ``landing.ranking``)."""
    sites, wanted = content.sites, "target" in content.summary.get("landing", {})
    probability = np.asarray(sites.get("probability", np.nan), np.float64)
    room = np.round(np.minimum(sites["hazard_distance"], enough := enough_room(content)), 1)
    ample = [", ample room" * bool(k >= round(enough, 1)) for k in room]
    if not len(room) or np.isnan(probability).any():
        return ["lowest score"] * (len(room) > 0) + ["higher score"] * (len(room) - 1)
    risks, best = 1.0 - probability, int(np.argmax(probability)) + 1
    words = ["most probable"]
    texts = [shown(value) for value in probability]
    if best > 1 or texts[0] in texts[1:]:
        other = best if best > 1 else texts.index(texts[0], 1) + 1
        words = [f"equal to {other}{', most room' if room[0] > max(room[1:]) else ample[0]}"]
    for k in range(1, len(risks)):
        equal = risks[k] <= equal_up_to(risks[k - 1])
        if equal and room[k] < room[k - 1]:
            words.append(f"equal to {k}, less room")
        elif wanted:
            words.append("farther from the planned point")
        elif equal and texts[k] == texts[k - 1]:
            words.append(f"equal to {k}{ample[k]}")
        else:
            words.append(f"less probable than {k}")
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
        lines.append("Nearest miss at x {x:.2f}, y {y:.2f} m: {why}".format(**miss))
    return ". ".join(lines) + "."


def when(content: Results) -> str:
    """Frame and time of the map."""
    frame = f"frame {content.config.frames.map}"
    stamp = content.summary.get("last_stamp_ns")
    if stamp is None:
        return frame
    if stamp < FIRST_DATE_NS:
        return f"{frame} · {1e-9 * stamp:.3f} s"
    moment = datetime.fromtimestamp(stamp / 1e9, tz=timezone.utc)
    return f"{frame} · {moment:%Y-%m-%d %H:%M:%S} UTC"
