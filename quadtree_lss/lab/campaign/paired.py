# SPDX-License-Identifier: Apache-2.0
"""Two campaigns flight by flight: what a change gained or cost on the same seeds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quadtree_lss.desk.replay.files import plain
from quadtree_lss.desk.replay.results import aligned
from quadtree_lss.lab.campaign.kinds import CampaignError, Quantity, kind_of
from quadtree_lss.lab.campaign.store import Record
from quadtree_lss.lab.campaign.summary import bootstrap, number, numbers, read_campaign


class Difference(NamedTuple):
    """Second minus first over flights of the same number and seed; 95 % interval of the mean."""

    quantity: Quantity
    first: float
    second: float
    mean: float
    low: float
    high: float
    better: int
    worse: int
    largest: float
    largest_flight: int | None
    count: int


@dataclass(frozen=True)
class Comparison:
    """Differences by quantity, and the number of flights without a partner."""

    differences: tuple[Difference, ...]
    unpaired: int

    def table(self) -> str:
        rows = [("", "first", "second", "difference", "95 % interval", "better / worse", "flight")]
        for d in self.differences:
            digits = f".{max(d.quantity.digits, 2)}f"
            flight = "–" if d.largest_flight is None else str(d.largest_flight)
            values = f"{d.first:{digits}}", f"{d.second:{digits}}", f"{d.mean:+{digits}}"
            interval = "–" if d.low != d.low else f"{d.low:+{digits}} … {d.high:+{digits}}"
            rows.append((d.quantity.title, *values, interval, f"{d.better} / {d.worse}", flight))
        lines = aligned(rows)
        pairs = max((d.count for d in self.differences), default=0)
        lines.append(f"{pairs} pairs of flights; the flight is where the second lost most")
        if self.unpaired:
            lines.append(f"{self.unpaired} flights have no partner of the same number and seed")
        return "\n".join(lines)

    def as_dict(self) -> dict[str, Any]:
        rows = {d.quantity.name: plain(numbers(d)) for d in self.differences}
        return {"differences": rows, "unpaired": self.unpaired}


def compare_campaigns(first: str | Path, second: str | Path) -> Comparison:
    """Compare the folders of two campaigns, with flights paired by number and seed. Raises
    `CampaignError`: the kinds differ, or there is no pair."""
    (kind, one), (other_kind, two) = read_campaign(Path(first)), read_campaign(Path(second))
    if kind != other_kind:
        raise CampaignError(f"{first} is of kind {kind}, {second} of {other_kind}")
    pairs = [
        (one[index], two[index])
        for index in sorted(one.keys() & two.keys())
        if one[index].seed == two[index].seed
    ]
    if not pairs:
        raise CampaignError(f"{first} and {second} have no flight of the same number and seed")
    quantities = kind_of(kind).quantities
    differences = filter(None, (_difference(quantity, pairs) for quantity in quantities))
    unpaired = len(one) + len(two) - 2 * len(pairs)
    return Comparison(tuple(differences), unpaired)


def _difference(quantity: Quantity, pairs: list[tuple[Record, Record]]) -> Difference | None:
    values = np.array([[number(r, quantity.name) for r in pair] for pair in pairs])
    known = np.isfinite(values).all(axis=1)
    if not known.any():
        return None
    values = values[known]
    change = values[:, 1] - values[:, 0]
    gain = change if quantity.worst == "smallest" else -change
    low, high = bootstrap(change)
    at = int(gain.argmin())
    flight = pairs[int(np.flatnonzero(known)[at])][0].index if gain[at] < 0.0 else None
    means = (float(of.mean()) for of in (values[:, 0], values[:, 1], change))
    better, worse = int((gain > 0.0).sum()), int((gain < 0.0).sum())
    rest = better, worse, float(change[at]), flight, int(change.size)
    return Difference(quantity, *means, low, high, *rest)
