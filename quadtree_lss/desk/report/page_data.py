# SPDX-License-Identifier: Apache-2.0
"""Data of the scripts of ``report.html``: results as columns with limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from numpy.typing import ArrayLike, NDArray

from quadtree_lss.desk.exchange.saved import Results
from quadtree_lss.desk.report import headline, palette
from quadtree_lss.desk.report.pages import Columns
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.tree.cell_map import CellMap, peak

MAX_GRID_POINTS = 250_000  # larger grids are thinned
MAX_LEAVES = 80_000  # larger maps are embedded without their planes
MAX_ASSESSMENTS = 60  # assessments on the slider


@dataclass(frozen=True)
class Layer:
    """An additional layer, such as the truth. ``values`` (ny, nx) are numbers with a ``kind`` of
    `palette.MAPS` and ``limits``, or indices of ``classes``, pairs of name and colour."""

    name: str
    title: str
    values: NDArray[Any]
    unit: str = ""
    kind: str = "elevation"
    limits: tuple[float, float] | None = None
    classes: Sequence[tuple[str, str]] = ()
    note: str = ""


def page_data(content: Results, layers: Sequence[Layer] = ()) -> tuple[dict[str, Any], Columns]:
    """Collect the data for JSON and the columns it refers to."""
    columns, config = Columns(), content.config
    grid = _grid(content, columns)
    stride, target = grid["stride"], headline.last_moment(content).target
    stamps = content.timing["stamp_ns"]
    return {
        "grid": grid,
        "layers": [_layer(layer, columns, stride) for layer in layers],
        "leaves": _leaves(content.map, columns),
        "sites": _sites(content),
        "zone": content.zone,
        "noise": config.lidar.range_noise,
        "lander": {"radius": 0.5 * config.vehicle.diameter, "pad": config.vehicle.pad_radius},
        "miss": headline.nearest_miss(content),
        "target": None if target is None else target[1:3].tolist(),
        "landing": content.summary.get("landing") or {},
        "limit": {"risk": config.lss.max_risk, "good": 1.0 - headline.GOOD_PROBABILITY},
        "history": _history(content, columns, stride),
        "timing": {
            "seconds": _seconds(stamps, int(stamps[0]) if len(stamps) else 0),
            "map_ms": [round(value, 3) for value in content.timing["map_ms"].tolist()],
        },
        "hazards": [{"bit": b, "name": name, "colour": c} for b, name, c in palette.HAZARDS],
        "excluding": palette.excluding(config.lss.assessment),
        "colours": {"clear": palette.CLEAR_COLOUR, "site": palette.SITE_COLOUR},
        "maps": {
            kind: columns.whole(colormaps[name](np.arange(256), bytes=True)[:, :3], "u1")
            for kind, name in palette.MAPS.items()
        },
    }, columns


def _grid(content: Results, columns: Columns) -> dict[str, Any]:
    grid = content.grid
    stride = int(np.ceil(np.sqrt(max(grid["hazard"].size / MAX_GRID_POINTS, 1.0))))

    def thinned(name: str) -> NDArray[Any]:
        return grid[name][::stride, ::stride]

    limits, heights, lss = palette.colour_limits, grid["elevation"], content.config.lss
    steepest, mark = palette.top_limit(grid["slope_deg"])[1], lss.vehicle.max_slope_deg
    if lss.assessment == "touchdown":
        mark = lss.vehicle.lengths.touchdown_slope_deg
    slope = {"limits": (0.0, max(steepest, mark)), "mark": mark}
    found: dict[str, Any] = {
        "nx": len(grid["x"][::stride]),
        "ny": len(grid["y"][::stride]),
        "xmin": float(grid["x"][0]),
        "ymin": float(grid["y"][0]),
        "spacing": content.grid.spacing * stride,
        "stride": stride,
        "elevation": columns.quantised(thinned("elevation"), min_step=5e-4, limits=limits(heights)),
        "slope": columns.quantised(thinned("slope_deg"), min_step=5e-3, **slope),
        "score": columns.quantised(thinned("score"), min_step=2e-4, limits=limits(grid["score"])),
    }
    for name in ("hazard", "safe"):
        found[name] = columns.whole(thinned(name), "u1")
    if content.probability is not None:
        known = np.where(grid.seen, grid["risk"], np.nan)[::stride, ::stride]
        for name, values in (("risk", known), ("aim", 1.0 - thinned("probability"))):
            ends = _log_risk([0.0, 1.0]).tolist()
            found[name] = columns.quantised(_log_risk(values), limits=ends)
    return found


def _log_risk(risks: ArrayLike) -> Array:
    """Decimal logarithms of risks, clipped at `palette.MIN_SHOWN_RISK`."""
    return np.asarray(np.log10(np.maximum(risks, palette.MIN_SHOWN_RISK)))


def _layer(layer: Layer, columns: Columns, stride: int) -> dict[str, Any]:
    values = layer.values[::stride, ::stride]
    header = {"name": layer.name, "title": layer.title, "unit": layer.unit, "note": layer.note}
    if layer.classes:
        classes = [{"name": name, "colour": colour} for name, colour in layer.classes]
        return {**header, "classes": classes, "values": columns.whole(values, "u1")}
    limits = layer.limits or palette.colour_limits(layer.values)
    return {**header, "kind": layer.kind, "values": columns.quantised(values, limits=limits)}


def _leaves(cells: CellMap, columns: Columns) -> dict[str, Any]:
    domain = cells.domain
    found: dict[str, Any] = {
        "number": len(cells.level),
        **{k: getattr(domain, k) for k in ("xmin", "ymin", "size", "min_level", "max_level")},
        "level": columns.whole(cells.level, "u1"),
        "ix": columns.whole(cells.ix, "u2"),
        "iy": columns.whole(cells.iy, "u2"),
    }
    if found["number"] > MAX_LEAVES:
        return found
    estimated = np.isfinite(cells.z)
    with np.errstate(invalid="ignore"):
        deviation = np.where(estimated, np.sqrt(cells.covariance[:, 2, 2]), np.nan)
        relative = np.where(estimated, np.sqrt(cells.covariance_range[:, 2, 2]), np.nan)
        slopes = np.where(estimated[:, None], -cells.normal[:, :2] / cells.normal[:, 2:], np.nan)
    rough = cells.roughness / cells.size**2  # Eq. 55 by area: distance from the plane
    shown = np.isfinite(cells.feature[:, 0])
    height = np.full(found["number"], np.nan)
    height[shown] = peak(cells.feature[shown])
    bounds = {"low": cells.low, "high": cells.high}
    known = {name: columns.quantised(v) for name, v in bounds.items() if np.isfinite(v).any()}
    return {
        **found,
        **known,
        "z": columns.quantised(cells.z),
        "slope_x": columns.quantised(slopes[:, 0]),
        "slope_y": columns.quantised(slopes[:, 1]),
        "deviation": columns.quantised(deviation, limits=palette.top_limit(deviation)),
        "relative": columns.quantised(relative, limits=palette.top_limit(relative)),
        "roughness": columns.quantised(rough, limits=palette.top_limit(rough)),
        "exceptions": columns.quantised(cells.exception_fraction, "u1"),
        "feature": columns.quantised(height),
        "count": columns.whole(cells.count, "u4"),
        "measured": columns.whole(cells.measured, "u1"),
    }


def _sites(content: Results) -> list[dict[str, Any]]:
    names = [name for name in content.sites if name not in ("rank", "nx", "ny", "nz")]
    rated = headline.ratings(content)
    return [
        {
            "rank": k + 1,
            **{n: _json(content.sites[n][k]) for n in names},
            "reason": reason,
            "level": level,
            "against": against,
        }
        for k, (reason, (level, against)) in enumerate(zip(content.reasons, rated, strict=True))
    ]


def _json(values: ArrayLike) -> Any:
    """Convert numbers to JSON types; those that are not finite become None."""
    return np.where(np.isfinite(values), values, None).tolist()


def _history(content: Results, columns: Columns, stride: int) -> dict[str, Any] | None:
    """Assessments and scans, times in s since the first; None with fewer than two assessments."""
    history = content.history
    answers = history.get("answer_stamp_ns", np.zeros(0))
    mapped = np.flatnonzero(answers > 0)
    if len(mapped) < 2:
        return None
    scans = history["scan_stamp_ns"]
    first = int(min(scans.min(initial=answers[mapped[0]]), answers[mapped].min()))
    shown = mapped[np.unique(np.linspace(0, len(mapped) - 1, MAX_ASSESSMENTS).round().astype(int))]

    masks = {name: content.history_layer(name, shown).astype(bool) for name in ("seen", "allowed")}

    def packed(name: str) -> NDArray[Any]:
        bits = masks[name][:, ::stride, ::stride]
        return np.packbits(bits.reshape(len(shown), -1), axis=1)

    # Differences between assessments are nearly all zero and compress well.
    seen = packed("seen")
    seen[1:] ^= seen[:-1].copy()
    likely = {}
    if "risk" in history:
        found = content.history_layer("risk", shown)[:, ::stride, ::stride]
        likely["risk"] = columns.whole(np.diff(found, axis=0, prepend=np.uint8(0)), "u1")
    names = ("site_id", "site_position", "site_score", "site_probability")
    sites = np.column_stack([history[name] for name in names])
    outline = history["scan_outline"]

    def verdict_then(k: int, answer: int) -> dict[str, Any]:
        then = headline.past_moment(content, answer, masks["seen"][k], masks["allowed"][k])
        return headline.verdict(content, then)._asdict()

    return {
        "first_ns": first,
        "seconds": _seconds(answers[shown], first),
        "seen": columns.whole(seen, "u1"),
        "allowed": columns.whole(packed("allowed"), "u1"),
        **likely,
        "verdicts": [verdict_then(k, int(answer)) for k, answer in enumerate(shown)],
        "sites": [_json(sites[history["site_answer"] == answer]) for answer in shown],
        "targets": _json(history["target"][shown]),
        "why": history["target_why"][shown].tolist(),
        "scan_seconds": _seconds(scans, first),
        "position": columns.floats(history["scan_position"]),
        "outline": columns.floats(outline),
        "corners": outline.shape[1],
    }


def _seconds(stamps: NDArray[Any], first: int) -> list[float]:
    return [round((stamp - first) / 1e9, 4) for stamp in stamps.tolist()]
