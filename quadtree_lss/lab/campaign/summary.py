# SPDX-License-Identifier: Apache-2.0
"""Summary of a campaign: rates and means with confidence intervals, the worst flights, the page."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from quadtree_lss.desk.replay.files import plain, write_csv
from quadtree_lss.desk.replay.results import aligned
from quadtree_lss.desk.report.pages import Columns, render, source
from quadtree_lss.lab.campaign.kinds import Quantity, Record
from quadtree_lss.lab.campaign.study import Study

#: Number of listed flights: the worst by one quantity, and failed ones in the printed table.
LISTED, LISTED_FAILED = 5, 10

#: Colours of combinations, from the palette of Okabe and Ito.
COLOURS = ("#e69f00", "#0072b2", "#cc79a7", "#009e73", "#d55e00", "#56b4e9")


class Line(NamedTuple):
    """Mean or rate of a quantity over many flights, its 95 % interval, and the worst flight."""

    quantity: Quantity
    mean: float
    low: float
    high: float
    worst: float
    worst_flight: int | None
    count: int
    events: int | None = None

    def cells(self) -> tuple[str, str, str, str, str]:
        """Cells of a table: name, mean or count, interval, worst value, worst flight."""
        q, flight = self.quantity, "–" if self.worst_flight is None else str(self.worst_flight)
        if self.events is not None:
            bounds = f"{100.0 * self.low:.2f} … {100.0 * self.high:.2f} %" if self.count else "–"
            return q.label, f"{self.events} of {self.count}", bounds, "–", flight
        mean, low, high, worst = (
            "–" if value != value else f"{value:.{q.digits}f}"
            for value in (self.mean, self.low, self.high, self.worst)
        )
        return q.title, mean, "–" if low == "–" else f"{low} … {high}", worst, flight


def number(record: Record, name: str) -> float:
    """A figure or label of a flight as a number; NaN if it is not one."""
    value = record.figures.get(name, record.labels.get(name))
    return float(value) if isinstance(value, (int, float)) else float("nan")


def line_of(quantity: Quantity, records: Sequence[Record]) -> Line:
    """Summarise one quantity of the flights that have it."""
    values = np.array([number(record, quantity.name) for record in records])
    if quantity.of is None:
        kept = np.flatnonzero(np.isfinite(values))
        if not kept.size:
            return Line(quantity, *[float("nan")] * 4, None, 0)
        value = values[kept]
        extreme = int(value.argmin() if quantity.worst == "smallest" else value.argmax())
        worst = float(value[extreme]), records[int(kept[extreme])].index
        mean, reach = float(value.mean()), float("nan")
        if kept.size > 1:  # Student's t
            reach = float(stats.t.ppf(0.975, kept.size - 1) * stats.sem(value))
        return Line(quantity, mean, mean - reach, mean + reach, *worst, int(kept.size))
    events = int(np.nansum(values))
    trials = int(np.nansum([number(record, quantity.of) for record in records]))
    rate = events / trials if trials else float("nan")
    bad = max(records, key=lambda record: badness(quantity, record), default=None)
    worst = float("nan"), bad.index if bad and badness(quantity, bad) > 0.0 else None
    return Line(quantity, rate, *rate_interval(events, trials), *worst, trials, events)


def rate_interval(events: int, trials: int) -> tuple[float, float]:
    """95 % interval of a rate of ``events`` in ``trials`` (Clopper and Pearson)."""
    if trials == 0:
        return float("nan"), float("nan")
    bounds = stats.binomtest(events, trials).proportion_ci(0.95)
    return float(bounds.low), float(bounds.high)


def badness(quantity: Quantity, record: Record) -> float:
    """Badness of a flight, higher is worse; 0 without a counted event."""
    value = number(record, quantity.name)
    if quantity.of is not None and quantity.worst == "smallest":
        value = number(record, quantity.of) - value
    elif quantity.worst == "smallest":
        value = -value
    return value if value == value else float("-inf")


@dataclass(frozen=True)
class CampaignResult:
    """Records by number, including failed flights; ``interrupted``: not all were flown."""

    out: Path
    study: Study
    records: Mapping[int, Record]
    interrupted: bool = False

    @property
    def failed(self) -> dict[int, str]:
        return {index: r.error for index, r in self.records.items() if r.error}

    @cached_property
    def flown(self) -> list[Record]:
        """Records of the flights that did not fail."""
        return [record for record in self.records.values() if not record.error]

    @cached_property
    def lines(self) -> list[tuple[str, list[Line]]]:
        """Name (with the number of flights) and quantities of each combination."""
        study, found = self.study, []
        for k in range(len(study.combinations)):
            if part := [r for r in self.flown if r.index % len(study.combinations) == k]:
                own = [f"{k} {v}" for k, v in part[0].labels.items() if k not in study.drawn]
                name = f"{', '.join(own) or 'all flights'}: {len(part)}"
                found.append((name, [line_of(q, part) for q in study.kind.quantities]))
        return found

    def worst(self) -> list[tuple[Quantity, list[tuple[int, float]]]]:
        """The worst flights by each quantity with its values."""
        found = []
        for quantity in self.study.kind.quantities:
            rated = [(badness(quantity, r), r) for r in self.flown]
            best = min((bad for bad, _ in rated), default=0.0)
            least = max(best, 0.0) if quantity.of is not None else best
            ranked = sorted((-bad, r.index, r) for bad, r in rated if bad > least)[:LISTED]
            found.append((quantity, [(k, number(r, quantity.name)) for _, k, r in ranked]))
        return found

    def table(self) -> str:
        head, lines = ("", "mean", "95 % interval", "worst", "flight"), []
        for name, part in self.lines:
            lines += [name, *aligned([head, *(row.cells() for row in part)]), ""]
        failed = list(self.failed.items())[:LISTED_FAILED]
        lines += [f"flight {index} failed: {why}" for index, why in failed]
        return "\n".join(lines).rstrip()

    def as_dict(self) -> dict[str, Any]:
        def numbers(line: Line) -> dict[str, Any]:
            return {name: value for name, value in line._asdict().items() if name != "quantity"}

        parts = [
            {"name": name, "quantities": {line.quantity.name: numbers(line) for line in lines}}
            for name, lines in self.lines
        ]
        return plain(
            {
                "study": self.study.name,
                "kind": self.study.kind_name,
                "flights": len(self.records),
                "of": self.study.count,
                "interrupted": self.interrupted,
                "summary": parts,
                "worst": {q.name: pairs for q, pairs in self.worst()},
                "failed": self.failed,
            }
        )


def write_flights(path: Path, records: Iterable[Record]) -> None:
    """Write a row for each flight into a CSV file."""
    rows = []
    for r in records:
        of = {"flight": r.index, "seed": r.seed, "scenario": r.scenario}
        # The figure `error` is a distance from the aim.
        rows.append(of | r.labels | r.figures | {"failed": r.error})
    names = list(dict.fromkeys(name for row in rows for name in row))
    write_csv(path, names, ([row.get(name) for name in names] for row in rows))


def page(result: CampaignResult) -> str:
    """Render ``campaign.html``."""
    study, kind, flights = result.study, result.study.kind, result.flown
    note = f"{len(result.records)} of {study.count} flights"
    note += f", {len(result.failed)} failed" if result.failed else ""
    combination = [record.index % len(study.combinations) for record in flights]
    present, columns = sorted(set(combination)), Columns()
    titles = {name: name.replace("_", " ") for name in study.varied}
    titles |= {q.name: q.title for q in kind.quantities}
    means = [q.name for q in kind.quantities if q.of is None]
    first, worst = kind.quantities[0], [(q, pairs) for q, pairs in result.worst() if pairs]
    keep = f"quadtree-lss campaign STUDY.yaml --out {shlex.quote(str(result.out))} --keep"
    ranks = "worst", "second", "third", "fourth", "fifth"
    return render(
        "lab/campaign/campaign.html",
        title=f"Campaign {study.name}",
        note=f"interrupted: {note}" if result.interrupted else note,
        answers=[_verdict(name, lines[0]) for name, lines in result.lines],
        legend=[(name, COLOURS[k % len(COLOURS)]) for k, (name, _) in enumerate(result.lines)],
        lines=[(name, [line.cells() for line in lines]) for name, lines in result.lines],
        keep=keep,
        ranks=ranks[: max((len(pairs) for _, pairs in worst), default=0)],
        worst=[
            (q.title, [(f"{v:.{q.digits if q.of is None else 0}f}", k) for k, v in pairs])
            for q, pairs in worst
        ],
        failed=result.failed,
        data={
            "indices": [record.index for record in flights],
            "seeds": [str(record.seed) for record in flights],
            "groups": [present.index(k) for k in combination],
            "colours": list(COLOURS),
            "titles": titles,
            "columns": {
                name: columns.floats(np.array([number(record, name) for record in flights]))
                for name in titles
            },
            "bad": [first.of is not None and badness(first, r) > 0.0 for r in flights],
            "first": [*means[-1:], *means[:1]],
            "command": keep,
        },
        columns=columns.text(),
        program=source("lab/campaign/campaign.js"),
    )


def _verdict(name: str, line: Line) -> tuple[str, str]:
    """Sentence on the first quantity of a combination, and its level of trust."""
    label, value, interval, _, _ = line.cells()
    words = f"{name.rpartition(':')[0]}: {label} {value}, 95 %: {interval}."
    if line.events is None:
        return words, "even"
    bad = line.count - line.events if line.quantity.worst == "smallest" else line.events
    return words, "none" if bad else "good"
