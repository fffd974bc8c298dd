# SPDX-License-Identifier: Apache-2.0
"""What a value in a study stands for: one, several in turn, or one that each flight draws."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from quadtree_lss.lab.campaign.kinds import CampaignError, Value

MOST_FLIGHTS = 1_000_000


def _normal(generator: np.random.Generator, mean: float, sigma: float) -> float:
    return float(generator.normal(mean, sigma))


def _uniform(generator: np.random.Generator, low: float, high: float) -> float:
    return float(generator.uniform(low, high))


def _log_uniform(generator: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(generator.uniform(np.log(low), np.log(high))))


DRAWN: dict[str, Callable[[np.random.Generator, float, float], float]] = {
    "uniform": _uniform,
    "log_uniform": _log_uniform,
    "normal": _normal,
}


@dataclass(frozen=True)
class Drawn:
    """A value that each flight draws for itself."""

    how: str
    of: tuple[Any, ...]

    def draw(self, generator: np.random.Generator) -> Value:
        """One value."""
        if self.how == "choice":
            chosen: Value = self.of[int(generator.integers(len(self.of)))]
            return chosen
        return DRAWN[self.how](generator, *self.of)


def values_of(value: Any, name: str) -> list[Any]:
    """What a value in a study stands for: one, several in turn, or one that is drawn."""
    if isinstance(value, list):
        if not value:
            msg = f"{name}: an empty list"
            raise CampaignError(msg)
        return value
    if not isinstance(value, Mapping):
        return [value]
    how, of = next(iter(value.items())) if len(value) == 1 else ("", None)
    try:
        if how == "each" and isinstance(of, list) and of:
            return of
        if how == "range" and isinstance(of, list):
            first, last, number = of
            return [float(v) for v in np.linspace(first, last, int(number))]
        if how == "choice" and isinstance(of, list) and of:
            return [Drawn(how, tuple(of))]
        if how in DRAWN and isinstance(of, list):
            low, high = (float(v) for v in of)
            positive = low > 0.0 if how == "log_uniform" else high > 0.0 or how == "uniform"
            if np.isfinite([low, high]).all() and positive and (low < high or how == "normal"):
                return [Drawn(how, (low, high))]
    except (TypeError, ValueError):
        pass
    msg = (
        f"{name}: {value} is no value, list, range: [first, last, number], each: [...],"
        " choice: [...], uniform: [low, high], log_uniform: [low, high], normal: [mean, sigma]"
    )
    raise CampaignError(msg)


def parse_seeds(text: str) -> list[int]:
    """Numbers from ``101-120``, ``1,2,7`` or both, each once; raises `CampaignError`."""
    seeds: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if not first <= last < first + MOST_FLIGHTS:
            msg = f"{text!r}: expected numbers and ranges, such as 101-120 or 1,2,7"
            raise CampaignError(msg)
        seeds += range(first, last + 1)
    if len(set(seeds)) < len(seeds):
        msg = f"{text!r}: a number is named more than once"
        raise CampaignError(msg)
    return seeds
