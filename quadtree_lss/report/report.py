# SPDX-License-Identifier: Apache-2.0
"""``report.html``: what a person looks at first, in one file that needs nothing else."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure

from quadtree_lss.config.settings import Config, parameters, values_from_config
from quadtree_lss.report import figures
from quadtree_lss.report.page_data import page_data

if TYPE_CHECKING:
    from quadtree_lss.replay.result import ReplayResult

# Nothing may be loaded from anywhere, whatever stands in a topic's name.
POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"

VIEW = """
<div class="view">
<div class="frame"><canvas id="map" tabindex="0" aria-label="map"></canvas>
<div class="buttons"><button id="zoom-in" title="zoom in (+)">+</button>
<button id="zoom-out" title="zoom out (-)">−</button>
<button id="zoom-fit" title="whole map (0)">all</button></div>
<p class="note">Drag to move, wheel or pinch to zoom, click a row of the table to go to a site.
Keys: arrows, +, −, 0.</p></div>
<div>
<fieldset><legend>Layer</legend><div id="layers"></div></fieldset>
<fieldset><legend id="layer-title"></legend><div id="legend"></div></fieldset>
<fieldset><legend>Show</legend>
<label><input type="checkbox" id="show-leaves" checked> leaves of the quadtree</label>
<label><input type="checkbox" id="show-sites" checked> sites and landing zones</label>
<label><input type="checkbox" id="show-relief"> relief shading</label></fieldset>
<fieldset><legend>Under the pointer</legend><table id="values"></table></fieldset>
</div></div>
<noscript><p class="warning">This page draws its map with JavaScript, which is off. The same
pictures are in the folder figures beside it.</p></noscript>
"""
CHARTS = """
<div class="charts"><canvas id="chart-ms"></canvas><canvas id="chart-leaves"></canvas>
<canvas id="chart-points"></canvas></div>
"""


def report_files(result: ReplayResult, config: Config) -> dict[str, bytes]:
    """The page and its figures: content by path in the results folder."""
    drawn = {
        "elevation": figures.elevation_figure(result.cells, result.assessment),
        "slope": figures.slope_figure(result.assessment, config),
        "hazards": figures.hazard_figure(result.assessment, config),
        "score": figures.score_figure(result.assessment, config),
    }
    if result.timings:
        drawn["timing"] = figures.timing_figure(result.timings)
    pictures = {f"figures/{name}.png": _png(figure) for name, figure in drawn.items()}
    return {**pictures, "report.html": page(result, config).encode()}


def _png(figure: Figure) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=130)
    return content.getvalue()


def page(result: ReplayResult, config: Config) -> str:
    """The page as text."""
    title = f"Landing sites from {escape(short_name(result.summary['bag']))}"
    warnings = "".join(
        f'<p class="warning">{escape(line)}</p>' for line in (*result.losses, *result.warnings)
    )
    embedded = json.dumps(page_data(result, config), allow_nan=False).replace("<", "\\u003c")
    summary = result.summary
    timing = f"<h2>Timing</h2>{CHARTS}" if result.timings else ""
    here = files("quadtree_lss.report")
    style, script = (here.joinpath(name).read_text("utf-8") for name in ("page.css", "page.js"))
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        f"<title>{title}</title><style>\n{style}</style></head><body>\n"
        f"<h1>{title}</h1>\n{_verdict(result)}\n{_cards(summary)}\n{warnings}\n{VIEW}\n"
        f"<h2>Ranked sites</h2>\n{_sites(result)}\n{timing}\n"
        f'<div class="columns"><div><h2>Run</h2>\n{_plain_table(_run(summary))}</div>\n'
        f"<div><h2>Input</h2>\n{_plain_table(_input(summary))}{_points(summary)}</div></div>\n"
        f"<h2>Configuration</h2>\n{_configuration(config)}\n"
        f'<script id="data" type="application/json">{embedded}</script>\n'
        f"<script>\n{script}</script>\n</body></html>\n"
    )


def _verdict(result: ReplayResult) -> str:
    sites, text = result.assessment.sites, escape(result.assessment.explanation)
    if not len(sites.score):
        return f'<p class="verdict none"><b>No safe site.</b> {text}</p>'
    x, y, z = sites.position[0]
    return (
        f'<p class="verdict"><b>{len(sites.score)} landing sites.</b> Best at'
        f" x {x:.2f}, y {y:.2f}, z {z:.2f} m: {escape(sites.reasons[0])}. {text}.</p>"
    )


def _cards(summary: Mapping[str, Any]) -> str:
    dropped = sum(summary["scans_dropped"].values())
    cards = [(f"{summary['maps']}", "maps read, the last assessed")]
    if summary["scans"]:
        cards = [
            (f"{summary['scans']}", "scans mapped"),
            (f"{dropped}", "scans dropped"),
            (_ms(summary["map_ms_median"]), "map update, median"),
            (_ms(summary["map_ms_p99"]), "map update, 99 %"),
        ]
    cards += [
        (f"{summary['leaves']}", "leaves"),
        (_ms(summary["lss_ms"]), "site selection"),
        (f"{summary['real_time_factor']:.1f} ×", "real time, reading included"),
    ]
    inner = "".join(f"<div><b>{value}</b><span>{name}</span></div>" for value, name in cards)
    return f'<div class="cards">{inner}</div>'


def _ms(value: float | None) -> str:
    return "–" if value is None or value != value else f"{value:.2f} ms"


def _sites(result: ReplayResult) -> str:
    sites = result.assessment.sites
    if not len(sites.score):
        return f"<p>None. {escape(result.assessment.explanation)}</p>"
    header = ["rank", "x, m", "y, m", "z, m", "score", "slope, deg", "roughness, m"]
    header += ["to hazard, m", "subscale height, m", "why"]
    rows = [
        (
            k + 1,
            *(f"{value:.2f}" for value in sites.position[k]),
            f"{sites.score[k]:.4f}",
            f"{sites.slope_deg[k]:.2f}",
            f"{sites.roughness[k]:.3f}",
            f"{sites.hazard_distance[k]:.2f}",
            f"{sites.subscale_height[k]:.2f}",
            sites.reasons[k],
        )
        for k in range(len(sites.score))
    ]
    marks = [f' data-site="{k}"' for k in range(len(rows))]
    return _table(header, rows, marks)


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
        ("observed / configured range noise", "–" if ratio != ratio else f"{ratio:.2f}"),
        ("peak memory", f"{summary['peak_memory_mb']:.0f} MB"),
        ("versions", ", ".join(f"{k} {v}" for k, v in summary["versions"].items())),
    ]


def _input(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    topics = ", ".join(filter(None, (summary["scan_topic"], summary["pose_topic"])))
    return [
        ("bag", f"{summary['bag']}, {summary['duration']:.2f} s"),
        ("topics", topics or "map topics alone"),
        ("scans mapped", _with_rate(summary["scans"], summary["scan_rate"])),
        ("scans dropped", _counts(summary["scans_dropped"])),
        ("poses", _with_rate(summary["poses"], summary["pose_rate"])),
        ("messages rejected", _counts(summary["messages_rejected"])),
    ]


def short_name(bag: str) -> str:
    """The name of a bag; with its folder's if it is plain ``bag``."""
    path = Path(bag)
    return f"{path.parent.name}/{path.name}" if path.name == "bag" else path.name


def _with_rate(count: int, rate: float) -> str:
    """A number of messages and the rate of their topic, as ``info`` tells it."""
    return f"{count}" if rate != rate else f"{count}, recorded at {rate:.2f} Hz"


def _points(summary: Mapping[str, Any]) -> str:
    """Where the points went, each reason with its share of all."""
    total = summary["points"]
    if not total:
        return ""
    dropped = {reason: n for reason, n in summary["points_dropped"].items() if n}
    parts = {"used": summary["points_used"], **dropped}
    body = "".join(
        f"<tr><td>{escape(reason.replace('_', ' '))}</td><td>{n}</td><td>{n / total:.2%}</td>"
        f'<td class="text"><span class="bar" style="width:{8.0 * n / total:.2f}rem"></span></td>'
        "</tr>"
        for reason, n in parts.items()
    )
    return f"<table><tr><th>points</th><th>{total}</th><th></th><th></th></tr>{body}</table>"


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
    table = _table(header, rows, marks, ' id="configuration"')
    changed = sum(map(bool, marks))
    return (
        f'<p class="note">{changed} of {len(rows)} parameters differ from their defaults (tinted).'
        ' <input type="search" id="filter" placeholder="filter parameters"></p>'
        f"<details open><summary>All parameters</summary>{table}</details>"
    )


def _table(
    header: Sequence[str],
    rows: Iterable[Iterable[object]],
    marks: Iterable[str] | None = None,
    attributes: str = "",
) -> str:
    rows = [tuple(row) for row in rows]
    marks = [""] * len(rows) if marks is None else list(marks)
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join(
        f"<tr{mark}>" + "".join(map(_cell, row)) + "</tr>"
        for mark, row in zip(marks, rows, strict=True)
    )
    head = f"<thead><tr>{head}</tr></thead>" if head else ""
    return f'<div class="scroll"><table{attributes}>{head}<tbody>{body}</tbody></table></div>'


def _plain_table(rows: Iterable[Iterable[object]]) -> str:
    return _table((), rows, attributes=' class="plain"')


def _cell(value: object) -> str:
    text = str(value)
    kind = ' class="text"' if any(c.isalpha() for c in text) else ""
    return f"<td{kind}>{escape(text)}</td>"
