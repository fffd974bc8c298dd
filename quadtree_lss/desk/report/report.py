# SPDX-License-Identifier: Apache-2.0
"""``report.html``: what a person looks at first, made of a results folder."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from quadtree_lss.desk.report import figures
from quadtree_lss.desk.report.answer import headline, largest_circle, nearest_miss, when
from quadtree_lss.desk.report.content import Content, read
from quadtree_lss.desk.report.page_data import Layer, page_data
from quadtree_lss.desk.report.template import document, plain_table, source, table
from quadtree_lss.onboard.config.settings import Config, parameters, values_from_config
from quadtree_lss.onboard.core.landing.probability import shown

SCRIPTS = (
    "vendor/uplot.min.js",
    *(
        f"{name}.js"
        for name in (
            "columns",
            "ground",
            "layers",
            "map",
            "marks",
            "pointer",
            "charts",
            "section",
            "time",
            "scene",
            "panel",
            "start",
        )
    ),
)
LIBRARIES = ("three", "uplot")
STYLES = ("vendor/uplot.min.css", "page.css")


def report_files(folder: str | Path) -> dict[str, bytes]:
    """The page of a results folder and its figures: content by path in the folder."""
    content = read(folder)
    drawn = {
        "elevation": figures.elevation_figure(content),
        "slope": figures.slope_figure(content),
        "hazards": figures.hazard_figure(content),
        "score": figures.score_figure(content),
    }
    if content.probability is not None:
        drawn["probability"] = figures.probability_figure(content)
    if len(content.timing["map_ms"]):
        drawn["timing"] = figures.timing_figure(content)
    pictures = {f"figures/{name}.png": _png(figure) for name, figure in drawn.items()}
    return {**pictures, "report.html": page(content).encode()}


def _png(figure: Figure) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=130)
    return content.getvalue()


def page(
    content: Content,
    *,
    title: str = "",
    layers: Sequence[Layer] = (),
    lead: str = "",
    more: str = "",
) -> str:
    """The page as text.

    Args:
        content: What it shows.
        title: Plain text; by default the bag's name.
        layers: Shown before those of the results.
        lead, more: Markup below the answer and below the first screen.
    """
    title = title or f"Landing sites from {short_name(content.summary['bag'])}"
    data, columns = page_data(content, layers)
    return document(
        title,
        _body(content, title, lead, more),
        data=data,
        columns=columns,
        scripts=SCRIPTS,
        styles=STYLES,
        libraries={"library-3d": "vendor/three.min.js"},
    )


def _body(content: Content, title: str, lead: str, more: str) -> str:
    summary = content.summary
    answer, ground = headline(content)
    none = "" if len(content.sites["x"]) else " none"
    view = source("view.html").replace("{{sites}}", _sites(content))
    timing = ""
    if len(content.timing["map_ms"]):
        timing = '<h2>Processing</h2><div class="charts" id="charts"></div>'
    return (
        f'<div class="first"><header><h1>{escape(title)}</h1>'
        f"<span>{escape(when(content))}</span></header>\n"
        f'<p class="verdict{none}"><b>{escape(answer)}</b> {escape(ground)}</p>\n'
        f"{lead}{_warnings(summary)}\n{view}\n</div>{more}\n{_reasons(content)}\n{timing}\n"
        f'<div class="columns"><div><h2>Run</h2>\n{plain_table(_run(summary))}</div>\n'
        f"<div><h2>Input</h2>\n{plain_table(_input(summary))}{_points(summary)}</div></div>\n"
        f"<h2>Configuration</h2>\n{_configuration(content.config)}\n{_licences()}"
    )


def _warnings(summary: Mapping[str, Any]) -> str:
    lines = [*summary.get("losses", ()), *summary.get("warnings", ())]
    if not lines:
        return ""
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    count = "1 warning" if len(lines) == 1 else f"{len(lines)} warnings"
    return (
        f'<details class="warning"><summary>{count}: {escape(lines[0])}</summary>'
        f"<ul>{items}</ul></details>"
    )


def _sites(content: Content) -> str:
    sites = content.sites
    if not len(sites["x"]):
        marks = [
            "? the nearest miss" if nearest_miss(content) else "",
            "the dashed circle the largest one of clear ground" if largest_circle(content) else "",
        ]
        drawn = " and ".join(filter(None, marks))
        on_map = f" On the map, {drawn}." if drawn else ""
        return f'<p class="note">No site: the answer above says what limits.{on_map}</p>'
    chosen = [
        ("x", "m", "x", "{:.2f}"),
        ("y", "m", "y", "{:.2f}"),
        ("z", "m", "z", "{:.2f}"),
        ("safe", "%", "probability", ""),
        ("score", "", "score", "{:.3f}"),
        ("slope", "°", "slope_deg", "{:.1f}"),
        ("clear", "m", "hazard_distance", "{:.1f}"),
        ("rough", "m", "roughness", "{:.3f}"),
        ("feature", "m", "subscale_height", "{:.2f}"),
    ]
    if "probability" not in sites or not np.isfinite(sites["probability"]).any():
        chosen = [row for row in chosen if row[2] != "probability"]
    head = "".join(
        f'<th title="{escape(_MEANING[name])}">{word}<small>{unit}</small></th>'
        for word, unit, name, _ in chosen
    )
    body = "".join(
        f'<tr data-site="{k}" tabindex="0" aria-label="site {k + 1}"><th>{k + 1}</th>'
        + "".join(f"<td>{_shown(name, sites[name][k], form)}</td>" for *_, name, form in chosen)
        + "</tr>"
        for k in range(len(sites["x"]))
    )
    return (
        f'<table id="sites"><thead><tr><th>site<small>rank</small></th>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table>"
    )


def _shown(name: str, value: float, form: str) -> str:
    if not np.isfinite(value):
        return "–"
    if name == "probability":
        return shown(value).removesuffix(" %")
    return form.format(value)


_MEANING = {
    "x": "place, map frame",
    "y": "place, map frame",
    "z": "where the pads rest, map frame",
    "probability": "probability of a safe touchdown if aimed here",
    "score": "mean over the landing zone, lower is better",
    "slope_deg": "slope at the lander's scale",
    "hazard_distance": "how far the zone may move until it touches a hazard or unseen ground",
    "roughness": "greatest mean deviation from the planes in the zone",
    "subscale_height": "greatest height of a feature smaller than a cell in the zone",
}


def _reasons(content: Content) -> str:
    lines = [f"<li>{escape(reason)}</li>" for reason in content.reasons]
    return f'<div class="print"><h2>Why</h2><ol>{"".join(lines)}</ol></div>' if lines else ""


def _licences() -> str:
    """Of the libraries in the page."""
    texts = "\n\n".join(f"{name}\n\n{source(f'vendor/LICENSE.{name}')}" for name in LIBRARIES)
    return f"<details><summary>Libraries in this page</summary><pre>{escape(texts)}</pre></details>"


def _ms(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f} ms"


def _run(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    ratio = summary["range_noise_ratio"]
    return [
        (
            "map update, median / 99 %",
            f"{_ms(summary['map_ms_median'])} / {_ms(summary['map_ms_p99'])}",
        ),
        ("landing site selection", _ms(summary["lss_ms"])),
        ("speed, bag reading included", f"{summary['real_time_factor']:.1f} × real time"),
        ("leaves", f"{summary['leaves']}"),
        ("divisions refused", f"{summary['refused_divisions']}"),
        ("observed / configured range noise", "–" if ratio is None else f"{ratio:.2f}"),
        ("peak memory", f"{summary['peak_memory_mb']:.0f} MB"),
        ("versions", ", ".join(f"{k} {v}" for k, v in summary["versions"].items())),
    ]


def _input(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    topics = ", ".join(filter(None, (summary["scan_topic"], summary["pose_topic"])))
    rows = [
        ("bag", f"{summary['bag']}, {summary['duration']:.2f} s"),
        ("topics", topics or "map topics alone"),
        ("scans mapped", _with_rate(summary["scans"], summary["scan_rate"])),
        ("scans dropped", _counts(summary["scans_dropped"])),
        ("poses", _with_rate(summary["poses"], summary["pose_rate"])),
        ("messages rejected", _counts(summary["messages_rejected"])),
    ]
    if summary["maps"]:
        rows.append(("maps read, the last assessed", f"{summary['maps']}"))
    return rows


def short_name(bag: str) -> str:
    """The name of a bag; with its folder's if it is plain ``bag``."""
    path = Path(bag)
    return f"{path.parent.name}/{path.name}" if path.name == "bag" else path.name


def _with_rate(count: int, rate: float | None) -> str:
    """A number of messages and the rate of their topic, as ``info`` tells it."""
    return f"{count}" if rate is None else f"{count}, recorded at {rate:.2f} Hz"


def _points(summary: Mapping[str, Any]) -> str:
    """Where the points went, each reason with its share of all."""
    total = summary["points"]
    if not total:
        return ""
    dropped = {reason: n for reason, n in summary["points_dropped"].items() if n}
    parts = {"used": summary["points_used"], **dropped}
    body = "".join(
        f"<tr><td>{escape(reason.replace('_', ' '))}</td><td>{n:,}</td><td>{n / total:.2%}</td>"
        f'<td class="text"><span class="bar" style="width:{8.0 * n / total:.2f}rem"></span></td>'
        "</tr>"
        for reason, n in parts.items()
    )
    head = f"<tr><th>points</th><th>{total:,}</th><th></th><th></th></tr>"
    return f'<div class="scroll"><table>{head}{body}</table></div>'


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{reason} {n}" for reason, n in counts.items() if n) or "none"


def _configuration(config: Config) -> str:
    """Every parameter; those that differ from the default stand out."""
    values = values_from_config(config)
    rows, marks = [], []
    for row in parameters():
        rows.append((row.name, values[row.name], row.default, row.unit, row.doc))
        marks.append(' class="changed"' if values[row.name] != row.default else "")
    header = ("parameter", "value", "default", "unit", "meaning")
    found = table(header, rows, marks, ' id="configuration"')
    changed = sum(map(bool, marks))
    return (
        f'<p class="note">{changed} of {len(rows)} parameters differ from their defaults (tinted).'
        ' <input type="search" id="filter" placeholder="filter parameters"></p>'
        f"<details><summary>All parameters</summary>{found}</details>"
    )
