# SPDX-License-Identifier: Apache-2.0
"""``report.html``: what a person looks at first, in one file that needs nothing else."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Mapping
from html import escape
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure

from quadtree_lss.core.config import Config, parameters, values_from_config
from quadtree_lss.replay import figures
from quadtree_lss.replay.results import FIGURES, REPORT, write_bytes

if TYPE_CHECKING:
    from quadtree_lss.replay.replay import ReplayResult

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem;
  color: #222; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .15rem .7rem; text-align: right; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child, td.text { text-align: left; }
img { max-width: 100%; } .warning { background: #fdf0d5; padding: .4rem .8rem; }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(28rem, 1fr)); gap: 1rem; }
figure { margin: 0; } details { margin-top: 2rem; }
"""


def write_report(result: ReplayResult, config: Config) -> None:
    """Draws the figures into ``figures/`` and writes the page with copies of them."""
    drawn = {
        "elevation": figures.elevation_figure(result.cells, result.assessment),
        "slope": figures.slope_figure(result.assessment, config),
        "hazards": figures.hazard_figure(result.assessment),
        "score": figures.score_figure(result.assessment, config),
        "timing": figures.timing_figure(result.timings),
    }
    images = {name: _png(drawn[name]) for name in FIGURES}
    for name, image in images.items():
        write_bytes(result.out / "figures" / f"{name}.png", image)
    write_bytes(result.out / REPORT, _page(result, config, images).encode())


def _png(figure: Figure) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=130)
    return content.getvalue()


def _page(result: ReplayResult, config: Config, images: Mapping[str, bytes]) -> str:
    summary = result.summary
    title = f"Landing sites from {escape(str(summary['bag']))}"
    pictures = "".join(
        f'<figure><img alt="{name}" src="data:image/png;base64,'
        f'{base64.b64encode(images[name]).decode()}"></figure>'
        for name in FIGURES
    )
    warnings = "".join(
        f'<p class="warning">{escape(line)}</p>' for line in (*result.losses, *result.warnings)
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{title}</title><style>{STYLE}</style></head><body>\n"
        f"<h1>{title}</h1>\n{warnings}\n"
        f"<h2>Ranked sites</h2>\n{_sites(result)}\n"
        f'<div class="figures">{pictures}</div>\n'
        f"<h2>Run</h2>\n{_table(('', ''), _figures_of_run(summary))}\n"
        f"<h2>Input</h2>\n{_table(('', ''), _input(summary))}\n"
        f"<details><summary>Configuration</summary>{_configuration(config)}</details>\n"
        "</body></html>\n"
    )


def _sites(result: ReplayResult) -> str:
    sites = result.assessment.sites
    if not len(sites.score):
        return f'<p class="warning">No safe site. {escape(result.assessment.explanation)}</p>'
    header: tuple[str, ...] = (
        "rank",
        "x, m",
        "y, m",
        "z, m",
        "score",
        "slope, deg",
        "roughness, m³",
    )
    header = (*header, "hazard distance, m", "subscale height, m", "why")
    rows = [
        (
            rank,
            *(f"{value:.2f}" for value in sites.position[k]),
            f"{sites.score[k]:.4f}",
            f"{sites.slope_deg[k]:.2f}",
            f"{sites.roughness[k]:.3f}",
            f"{sites.hazard_distance[k]:.2f}",
            f"{sites.subscale_height[k]:.2f}",
            sites.reasons[k],
        )
        for k, rank in enumerate(range(1, len(sites.score) + 1))
    ]
    return _table(header, rows) + f"<p>{escape(result.assessment.explanation)}</p>"


def _figures_of_run(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [
        ("map update, median", f"{summary['map_ms_median']:.2f} ms"),
        ("map update, 99 %", f"{summary['map_ms_p99']:.2f} ms"),
        ("landing site selection", f"{summary['lss_ms']:.1f} ms"),
        ("speed, bag reading included", f"{summary['real_time_factor']:.1f} x real time"),
        ("leaves", f"{summary['leaves']}"),
        ("divisions refused", f"{summary['refused_divisions']}"),
        ("observed / configured range noise", f"{summary['range_noise_ratio']:.2f}"),
        ("peak memory", f"{summary['peak_memory_mb']:.0f} MB"),
        ("versions", ", ".join(f"{k} {v}" for k, v in summary["versions"].items())),
    ]


def _input(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [
        ("bag", f"{summary['bag']}, {summary['duration']:.2f} s"),
        ("topics", f"{summary['scan_topic']}, {summary['pose_topic']}"),
        ("scans mapped", f"{summary['scans']}"),
        ("scans dropped", _counts(summary["scans_dropped"])),
        ("poses", f"{summary['poses']}"),
        ("messages rejected", _counts(summary["messages_rejected"])),
        ("points", f"{summary['points']}"),
        ("points dropped", _counts(summary["points_dropped"])),
    ]


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{reason} {n}" for reason, n in counts.items() if n) or "none"


def _configuration(config: Config) -> str:
    values = values_from_config(config)
    rows = [(row.name, values[row.name], row.unit, row.doc) for row in parameters()]
    return _table(("parameter", "value", "unit", "meaning"), rows)


def _table(header: Iterable[object], rows: Iterable[Iterable[object]]) -> str:
    head = "".join(f"<th>{escape(str(cell))}</th>" for cell in header)
    body = "".join("<tr>" + "".join(map(_cell, row)) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


def _cell(value: object) -> str:
    text = str(value)
    kind = ' class="text"' if any(c.isalpha() for c in text) else ""
    return f"<td{kind}>{escape(text)}</td>"
