# SPDX-License-Identifier: Apache-2.0
"""``campaign.html``: the table, the worst flights, what explains the figures; and its pictures."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.stats import spearmanr

from quadtree_lss.desk.report.template import Markup, document, table
from quadtree_lss.lab.campaign.kinds import Quantity, kind_of
from quadtree_lss.lab.campaign.statistics import bootstrap
from quadtree_lss.lab.evaluation.plotting import RUNS

if TYPE_CHECKING:
    from quadtree_lss.lab.campaign.summary import CampaignResult

MOST_REASONS = 4
BINS = 6
RANKS = ("value: flight", "worst", "second", "third", "fourth", "fifth", "")


def page_files(result: CampaignResult, times: Sequence[Mapping[str, str]]) -> dict[str, bytes]:
    """Content by path in the campaign's folder."""
    drawn = {"figures/distributions.png": _distributions(result)}
    sensitivity = _sensitivity(result)
    if sensitivity is not None:
        drawn["figures/sensitivity.png"] = sensitivity
    pictures = {name: _png(figure) for name, figure in drawn.items()}
    return {**pictures, "campaign.html": _page(result, times, pictures).encode()}


def replay_command(result: CampaignResult, which: str) -> str:
    """What flies flights again and leaves everything there is to see."""
    return f"quadtree-lss campaign STUDY.yaml --out {result.out} --keep {which}"


def _page(
    result: CampaignResult, times: Sequence[Mapping[str, str]], pictures: Mapping[str, bytes]
) -> str:
    title = f"Campaign {result.study.name}"
    parts = []
    for name, lines in result.lines:
        header = ("", "mean or number", "95 % interval", "worst", "flight")
        parts.append(f"<h2>{escape(name)}</h2>{table(header, [line.cells() for line in lines])}")
    worst = [_worst(result, quantity, pairs) for quantity, pairs in result.worst() if pairs]
    failed = [(_link(result, index), why) for index, why in result.failed.items()]
    images = "".join(
        f'<p><img class="picture" alt="{escape(name)}"'
        f' src="data:image/png;base64,{base64.b64encode(content).decode()}"></p>'
        for name, content in pictures.items()
    )
    state = "interrupted: " if result.interrupted else ""
    note = f"{state}{len(result.records)} of {result.study.count} flights"
    if result.enough is not None:
        note += f", {result.enough} were enough"
    if failed:
        note += f", {len(failed)} failed"
    body = (
        f'<h1>{escape(title)}</h1>\n<p class="verdict">{escape(note)}.</p>\n{"".join(parts)}\n'
        '<h2>Worst flights</h2>\n<p class="note">A flight\'s number leads to its page once it is'
        f" kept: all of these by <code>{escape(replay_command(result, 'worst'))}</code>, flight 17"
        f" for instance by <code>{escape(replay_command(result, '17'))}</code></p>\n"
        f"{table(RANKS, worst)}\n<h2>What explains it</h2>\n{images}\n"
        + (f"<h2>Failed</h2>{table(('flight', 'why'), failed)}\n" if failed else "")
        + f"<h2>Time</h2>\n{_times(times)}"
    )
    return document(title, body)


def _worst(
    result: CampaignResult, quantity: Quantity, pairs: Sequence[tuple[int, float]]
) -> list[str]:
    """A row of `RANKS`."""
    digits = quantity.digits if quantity.of is None else 0
    label = f"{quantity.label} [{quantity.unit}]" if quantity.unit else quantity.label
    cells = [Markup(f"{value:.{digits}f}: {_link(result, index)}") for index, value in pairs]
    return [label, *cells, *[""] * (len(RANKS) - 1 - len(cells))]


def _link(result: CampaignResult, index: int) -> Markup:
    """To the page of a flight that is kept (`kept.keep`)."""
    page = kind_of(result.study.kind).page
    return Markup(f'<a href="kept/{index:06d}/{page}">{index}</a>')


def _times(rows: Sequence[Mapping[str, str]]) -> str:
    if not rows:
        return "<p>Nothing was flown here.</p>"
    shown = []
    for name in rows[0]:
        if name in ("index", "process"):
            continue
        values = np.array([float(row[name]) for row in rows if row.get(name)])
        shown.append((name, f"{np.median(values):.3g}", f"{values.max():.3g}"))
    return table(("of a flight", "median", "largest"), shown)


def _png(figure: Figure) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110)
    return content.getvalue()


def _figure(rows: int, columns: int) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(3.4 * columns, 2.7 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, np.asarray(figure.subplots(rows, columns, squeeze=False))


def _distributions(result: CampaignResult) -> Figure:
    """How each explained quantity is spread, combination by combination."""
    from quadtree_lss.lab.campaign.summary import flown, groups, number

    kind = result.study.what
    names = kind.explained or tuple(q.name for q in kind.quantities[:2])
    figure, panels = _figure(1, len(names))
    parts = groups(result.study, flown(result.records.values()))
    for axes, name in zip(panels[0], names, strict=True):
        for k, (label, records) in enumerate(parts[: len(RUNS)]):
            values = np.sort([number(record, name) for record in records])
            values = values[np.isfinite(values)]
            share = np.arange(1, values.size + 1) / max(values.size, 1)
            axes.step(values, 100.0 * share, where="post", color=RUNS[k], label=label)
        quantity = kind.quantity(name)
        axes.set_xlabel(f"{quantity.label} [{quantity.unit}]", fontsize="small")
        axes.set_ylabel("flights below [%]", fontsize="small")
        axes.grid(alpha=0.3)
    if len(parts) > 1:
        panels[0][0].legend(fontsize="x-small")
    return figure


def _sensitivity(result: CampaignResult) -> Figure | None:
    """Each explained quantity against what goes with it most, by rank correlation."""
    from quadtree_lss.lab.campaign.summary import flown, number

    kind, records = result.study.what, flown(result.records.values())
    rows = []
    for name in kind.explained:
        values = np.array([number(record, name) for record in records])
        found = []
        for by in (*result.study.varied, *kind.by):
            reasons = np.array([number(record, by) for record in records])
            both = np.isfinite(values) & np.isfinite(reasons)
            if both.sum() > 7 and np.ptp(reasons[both]) > 0.0 and np.ptp(values[both]) > 0.0:
                rank = float(spearmanr(reasons[both], values[both]).statistic)
                found.append((rank, by, reasons[both], values[both]))
        found.sort(key=lambda entry: -abs(entry[0]))
        if found:
            rows.append((kind.quantity(name), found[:MOST_REASONS]))
    if not rows:
        return None
    figure, panels = _figure(len(rows), max(len(found) for _, found in rows))
    for line, (quantity, found) in zip(panels, rows, strict=True):
        for axes in line[len(found) :]:
            axes.set_visible(False)
        for axes, (rank, by, reasons, values) in zip(line, found, strict=False):
            axes.plot(reasons, values, ".", ms=3, color=RUNS[5])
            for x, mean, low, high in _binned(reasons, values):
                axes.errorbar(x, mean, [[mean - low], [high - mean]], fmt="o", ms=4, color=RUNS[1])
            axes.set_title(f"rank correlation {rank:+.2f}", fontsize="small")
            axes.set_xlabel(by.replace("_", " "), fontsize="small")
            axes.grid(alpha=0.3)
        line[0].set_ylabel(f"{quantity.label} [{quantity.unit}]", fontsize="small")
    return figure


def _binned(reasons: np.ndarray, values: np.ndarray) -> Iterable[tuple[float, float, float, float]]:
    """Means with their intervals in bins of equal numbers."""
    order = np.argsort(reasons, kind="stable")
    for part in np.array_split(order, min(BINS, len(order) // 4)):
        low, high = bootstrap(values[part])
        mean = float(values[part].mean())
        yield float(np.median(reasons[part])), mean, min(low, mean), max(high, mean)
