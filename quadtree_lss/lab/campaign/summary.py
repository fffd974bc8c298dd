# SPDX-License-Identifier: Apache-2.0
"""Summary of a campaign: rates and means with intervals, and the worst flights."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from quadtree_lss.desk.replay.files import plain, write_bytes, write_csv, write_json
from quadtree_lss.desk.replay.results import aligned
from quadtree_lss.lab.campaign.kinds import Quantity
from quadtree_lss.lab.campaign.store import Record
from quadtree_lss.lab.campaign.study import Study

WORST = 5
"""Flights that are listed."""
FEW = 20
"""Flights of which the bootstrap's interval of the mean holds it in fewer than 93 of 100 cases."""


class Line(NamedTuple):
    """A quantity over many flights: its mean or rate, 95 % interval, and the worst flight."""

    quantity: Quantity
    mean: float
    low: float
    high: float
    worst: float
    worst_flight: int | None
    count: int
    events: int | None = None

    def cells(self) -> tuple[str, str, str, str, str]:
        q = self.quantity
        digits = f".{q.digits}f"
        flight = "–" if self.worst_flight is None else str(self.worst_flight)
        if self.events is not None:
            bounds = f"{100.0 * self.low:.2f} … {100.0 * self.high:.2f} %" if self.count else "–"
            return q.label, f"{self.events} of {self.count}", bounds, "–", flight
        interval = "–" if self.low != self.low else f"{self.low:{digits}} … {self.high:{digits}}"
        return q.title, _show(self.mean, digits), interval, _show(self.worst, digits), flight


def _show(value: float, digits: str) -> str:
    return "–" if value != value else f"{value:{digits}}"


def number(record: Record, name: str) -> float:
    """A figure or label of a flight as a number; NaN if it is none."""
    value = record.figures.get(name, record.labels.get(name))
    return float(value) if isinstance(value, (int, float)) else float("nan")


def line_of(quantity: Quantity, records: Sequence[Record]) -> Line:
    """One quantity of flights; those without the figure are left out."""
    values = np.array([number(record, quantity.name) for record in records])
    if quantity.of is None:
        kept = np.flatnonzero(np.isfinite(values))
        if not kept.size:
            return Line(quantity, *[float("nan")] * 4, None, 0)
        value = values[kept]
        at = int(value.argmin() if quantity.worst == "smallest" else value.argmax())
        worst = float(value[at]), records[int(kept[at])].index
        return Line(quantity, float(value.mean()), *bootstrap(value), *worst, int(kept.size))
    events = int(np.nansum(values))
    trials = int(np.nansum([number(record, quantity.of) for record in records]))
    rate = events / trials if trials else float("nan")
    bad = max(records, key=lambda record: badness(quantity, record), default=None)
    worst = float("nan"), bad.index if bad and badness(quantity, bad) > 0.0 else None
    return Line(quantity, rate, *rate_interval(events, trials), *worst, trials, events)


def bootstrap(values: NDArray[np.float64]) -> tuple[float, float]:
    """95 % interval of the mean of values (n,) by the bootstrap; of fewer than `FEW` by Student's
    distribution, because the bootstrap's would be too narrow; NaN for fewer than two values."""
    if values.size < 2:
        return float("nan"), float("nan")
    if values.size < FEW:
        error = float(values.std(ddof=1)) / values.size**0.5
        reach = float(stats.t.ppf(0.975, values.size - 1)) * error
        return float(values.mean()) - reach, float(values.mean()) + reach
    how = {"method": "percentile", "batch": max(500_000 // values.size, 1)}
    found = stats.bootstrap((values,), np.mean, n_resamples=2000, random_state=0, **how)
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


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


def flown(records: Iterable[Record]) -> list[Record]:
    return [record for record in records if not record.error]


def groups(study: Study, records: Iterable[Record]) -> list[tuple[str, list[Record]]]:
    """Flights of each combination, by its labels."""
    parts: dict[int, list[Record]] = {}
    for record in records:
        parts.setdefault(record.index % len(study.combinations), []).append(record)
    found = []
    for _, part in sorted(parts.items()):
        own = [f"{k} {v}" for k, v in part[0].labels.items() if k not in study.drawn]
        found.append((", ".join(own) or "all flights", part))
    return found


@dataclass(frozen=True)
class CampaignResult:
    """Records by number, with failed flights; ``interrupted``: not all were flown."""

    out: Path
    study: Study
    records: Mapping[int, Record]
    interrupted: bool = False

    @property
    def failed(self) -> dict[int, str]:
        return {index: r.error for index, r in self.records.items() if r.error}

    @cached_property
    def lines(self) -> list[tuple[str, list[Line]]]:
        """Each combination's name with its number of flights, and its quantities."""
        parts = groups(self.study, flown(self.records.values()))
        return [
            (f"{name}: {len(part)}", [line_of(q, part) for q in self.study.what.quantities])
            for name, part in parts
        ]

    def worst(self) -> list[tuple[Quantity, list[tuple[int, float]]]]:
        """The worst flights by each quantity, and its values."""
        found = []
        for quantity in self.study.what.quantities:
            least = 0.0 if quantity.of is not None else float("-inf")
            rated = [(badness(quantity, r), r) for r in flown(self.records.values())]
            least = max(least, min((bad for bad, _ in rated), default=least))  # the best are none
            ranked = sorted((-bad, r.index, r) for bad, r in rated if bad > least)[:WORST]
            found.append((quantity, [(k, number(r, quantity.name)) for _, k, r in ranked]))
        return found

    def table(self) -> str:
        head, lines = ("", "mean", "95 % interval", "worst", "flight"), []
        for name, part in self.lines:
            lines += [name, *aligned([head, *(row.cells() for row in part)]), ""]
        lines += [f"flight {index} failed: {why}" for index, why in list(self.failed.items())[:10]]
        return "\n".join(lines).rstrip()

    def as_dict(self) -> dict[str, Any]:
        parts = [
            {"name": name, "quantities": {row.quantity.name: numbers(row) for row in rows}}
            for name, rows in self.lines
        ]
        return plain(
            {
                "study": self.study.name,
                "kind": self.study.kind,
                "flights": len(self.records),
                "of": self.study.count,
                "interrupted": self.interrupted,
                "summary": parts,
                "worst": {q.name: pairs for q, pairs in self.worst()},
                "failed": self.failed,
            }
        )


def numbers(row: Any) -> dict[str, Any]:
    return {name: value for name, value in row._asdict().items() if name != "quantity"}


def write_summary(result: CampaignResult) -> None:
    """``campaign.json``, ``flights.csv`` and ``campaign.html``."""
    from quadtree_lss.lab.campaign.campaign_page import page

    write_json(result.out / "campaign.json", result.as_dict())
    _write_flights(result.out / "flights.csv", result.records.values())
    write_bytes(result.out / "campaign.html", page(result).encode())


def _write_flights(path: Path, records: Iterable[Record]) -> None:
    rows = []
    for r in records:
        of = {"flight": r.index, "seed": r.seed, "scenario": r.scenario}
        rows.append(of | r.labels | r.figures | {"failed": r.error})  # `error`: from the aim, m
    names = list(dict.fromkeys(name for row in rows for name in row))
    write_csv(path, names, ([row.get(name) for name in names] for row in rows))
