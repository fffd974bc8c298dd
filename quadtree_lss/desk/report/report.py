# SPDX-License-Identifier: Apache-2.0
"""``report.html`` of a results folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadtree_lss.desk.exchange.saved import Results, load_results
from quadtree_lss.desk.report import headline
from quadtree_lss.desk.report.figures import figures, png
from quadtree_lss.desk.report.page_data import Layer, page_data
from quadtree_lss.desk.report.pages import Columns, render
from quadtree_lss.onboard.config.settings import parameters, values_from_config
from quadtree_lss.onboard.core.landing.result import shown

ROOM_MEANING = "distance by which the zone can move before it touches excluded or unobserved ground"
FEATURE_MEANING = "largest height of a feature smaller than a cell in the zone"
SITE_COLUMNS = (
    ("x", "m", "x", "{:.2f}", "position, map frame"),
    ("y", "m", "y", "{:.2f}", "position, map frame"),
    ("success", "%", "probability", "", "probability of a safe touchdown if aimed here"),
    ("score", "", "score", "{:.3f}", "mean over the landing zone, lower is better"),
    ("room", "m", "hazard_distance", "{:.1f}", ROOM_MEANING),
    ("slope", "°", "slope_deg", "{:.1f}", "slope at the scale of the lander"),
    ("rough", "m", "roughness", "{:.3f}", "largest mean distance from the planes in the zone"),
    ("feature", "m", "subscale_height", "{:.2f}", FEATURE_MEANING),
)
"""Columns of the table of sites: heading, unit, name in ``sites.csv``, format, meaning."""


def report_files(folder: str | Path) -> dict[str, bytes]:
    """Make the page and the figures of a results folder; return contents by file path."""
    content = load_results(folder)
    pictures = {f"figures/{name}.png": png(figure) for name, figure in figures(content).items()}
    return {**pictures, "report.html": page(content).encode()}


def page(
    content: Results,
    layers: Sequence[Layer] = (),
    template: str = "desk/report/report.html",
    extra_data: Callable[[dict[str, Any], Columns], Mapping[str, Any]] | None = None,
    **values: Any,
) -> str:
    """Render the page. ``layers``: additional ones, shown first; ``template``: extends
    ``report.html`` and uses ``values``; ``extra_data``: returns further data for the scripts, from
    their data and columns."""
    data, columns = page_data(content, layers)
    data |= {} if extra_data is None else extra_data(data, columns)
    summary, sites, used = content.summary, content.sites, values_from_config(content.config)
    level, answer, ground, facts = headline.verdict(content)
    known = np.isfinite(sites.get("probability", np.array([]))).any()
    shown_columns = [row for row in SITE_COLUMNS if row[2] != ("score" if known else "probability")]
    cells = [
        [_format_cell(name, value, form) for value in sites[name]]
        for _, _, name, form, _ in shown_columns
    ]
    rows = [(row.name, used[row.name], row.default, row.unit, row.doc) for row in parameters()]
    shown_values = {
        "title": f"Landing sites from {short_name(summary['bag'])}",
        "when": headline.when(content),
        "answer": answer,
        "level": level,
        "facts": facts,
        "ground": ground,
        "warnings": [*summary.get("losses", ()), *summary.get("warnings", ())],
        "head": [
            *((word, unit, meaning) for word, unit, _, _, meaning in shown_columns),
            ("why this rank", "", ""),
        ],
        "enough_room": headline.enough_room(content) if known else None,
        "rows": [*zip(*cells, headline.rank_reasons(content), strict=True)],
        "levels": [(level, headline.LEVELS[level]) for level, _ in headline.ratings(content)],
        "nearest_miss": headline.nearest_miss(content) is not None,
        "reasons": content.reasons,
        "timed": len(content.timing["map_ms"]) > 0,
        "run": _run(summary),
        "input": _input(summary),
        "total": summary["points"],
        "points": {"used": summary["points_used"], **_positive(summary["points_dropped"])},
        "parameters": rows,
        "changed": [value != default for _, value, default, _, _ in rows],
        "columns": columns.text(),
        "data": data,
    }
    shown_values |= values
    data["verdict"] = {name: shown_values[name] for name in ("level", "answer", "ground", "facts")}
    return render(template, **shown_values)


def short_name(bag: str) -> str:
    """Name of a bag, with the name of its folder if it is only ``bag``."""
    path = Path(bag)
    return f"{path.parent.name}/{path.name}" if path.name == "bag" else path.name


def _format_cell(name: str, value: float, form: str) -> str:
    if not np.isfinite(value):
        return "–"
    return shown(value).removesuffix(" %") if name == "probability" else form.format(value)


def _run(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    def known(form: str, *names: str) -> str:
        values = [summary[name] for name in names]
        return "" if None in values else form.format(*values)

    speed, times = summary["real_time_factor"], ("map_ms_median", "map_ms_p99")
    rows = [
        ("map update, median / 99 %", known("{:.2f} ms / {:.2f} ms", *times)),
        ("landing site selection", known("{:.2f} ms", "lss_ms")),
        ("speed, bag reading included", f"{speed:.1f} × real time" if speed else ""),
        ("leaves", known("{}", "leaves")),
        ("observed / configured range noise", known("{:.2f}", "range_noise_ratio")),
        ("peak memory", known("{:.0f} MB", "peak_memory_mb")),
        ("versions", ", ".join(f"{k} {v}" for k, v in summary["versions"].items())),
    ]
    return [row for row in rows if row[1]]  # some are unknown for a bag of maps


def _input(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    if "posts" in summary:
        low, high = summary["height_range"]
        return [
            ("elevation model", summary["bag"]),
            ("posts", "{} × {}, {:g} m apart".format(*summary["posts"], summary["post_spacing"])),
            ("heights", f"{low:.2f} to {high:.2f} m"),
            ("coordinate system", summary["crs"] or "not known"),
        ]
    topics = ", ".join(filter(None, (summary["scan_topic"], summary["pose_topic"])))
    rates = (summary["scan_rate"], summary["pose_rate"])
    recorded = ["" if rate is None else f", recorded at {rate:.2f} Hz" for rate in rates]
    scans = [
        ("scans mapped", f"{summary['scans']}{recorded[0]}"),
        ("scans dropped", _counts(summary["scans_dropped"])),
        ("poses", f"{summary['poses']}{recorded[1]}"),
    ]
    rows = [
        ("bag", f"{summary['bag']}, {summary['duration']:.2f} s"),
        ("topics", topics or "map topics only"),
        *(scans if topics else ()),
        ("messages rejected", _counts(summary["messages_rejected"])),
    ]
    if summary["maps"]:
        rows.append(("maps read, the last assessed", f"{summary['maps']}"))
    return rows


def _positive(counts: Mapping[str, int]) -> dict[str, int]:
    return {reason: n for reason, n in counts.items() if n}


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{reason} {n}" for reason, n in _positive(counts).items()) or "none"
