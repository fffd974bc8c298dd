# SPDX-License-Identifier: Apache-2.0
"""Many runs in a few numbers: mean, worst, 95 % interval."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import beta

_RESAMPLES = 2000


@dataclass(frozen=True)
class Statistic:
    """One quantity over many seeds; NaN where it exists for none.

    ``low`` and ``high`` bound the mean with 95 % confidence (bootstrap over seeds, which assumes no
    shape of the distribution; NaN for fewer than two values, which tell no spread); ``worst`` is
    that of seed ``worst_seed``.
    """

    mean: float
    worst: float
    worst_seed: int | None
    low: float
    high: float
    count: int


def summarise(
    seeds: list[int], values: ArrayLike, worst: Literal["smallest", "largest"]
) -> Statistic:
    """Statistics of one value per seed; values that are NaN (nothing to measure) are left out."""
    all_values = np.asarray(values, np.float64)
    kept = np.flatnonzero(np.isfinite(all_values))
    if not kept.size:
        nan = float("nan")
        return Statistic(nan, nan, None, nan, nan, 0)
    value = all_values[kept]
    at = int(value.argmin() if worst == "smallest" else value.argmax())
    low = high = float("nan")
    if value.size > 1:
        low, high = bootstrap(value)
    return Statistic(
        mean=float(value.mean()),
        worst=float(value[at]),
        worst_seed=seeds[int(kept[at])],
        low=float(low),
        high=float(high),
        count=int(kept.size),
    )


def bootstrap(values: NDArray[np.float64]) -> tuple[float, float]:
    """Bounds of the mean of values (n,) with 95 % confidence, by drawing from them again."""
    generator = np.random.default_rng(0)
    rows = max(1, min(_RESAMPLES, 500_000 // values.size))
    means = [
        values[generator.integers(0, values.size, (rows, values.size))].mean(axis=1)
        for _ in range(-(-_RESAMPLES // rows))
    ]
    low, high = np.percentile(np.concatenate(means), (2.5, 97.5))
    return float(low), float(high)


def rate_interval(events: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Bounds of a rate from ``events`` in ``trials`` (Clopper and Pearson), both sides together."""
    if trials == 0:
        return float("nan"), float("nan")
    tail = 0.5 * (1.0 - confidence)
    low = float(beta.ppf(tail, events, trials - events + 1)) if events else 0.0
    high = float(beta.ppf(1.0 - tail, events + 1, trials - events)) if events < trials else 1.0
    return low, high


def upper_bound(events: int, trials: int, confidence: float = 0.95) -> float:
    """Largest rate that ``events`` in ``trials`` leave open (Clopper and Pearson); NaN if 0."""
    if trials == 0:
        return float("nan")
    if events >= trials:
        return 1.0
    return float(beta.ppf(confidence, events + 1, trials - events))
