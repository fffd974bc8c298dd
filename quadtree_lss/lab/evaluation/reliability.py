# SPDX-License-Identifier: Apache-2.0
"""Whether what was given a risk fails as often: proper scores and reliability."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadtree_lss.lab.evaluation.metrics import SafetyField
from quadtree_lss.onboard.arrays import Array, Mask

#: Bounds of the bins of predicted risk.
EDGES = (0.0, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
#: Of probabilities in a log score.
LEAST = 1e-6


@dataclass(frozen=True)
class RiskBin:
    """Grid points with a predicted risk from ``low`` to ``high``."""

    low: float
    high: float
    grid_points: int
    predicted: float
    """Mean risk; NaN without a grid point."""
    unsafe: float
    """Share that is truly unsafe; NaN without a grid point."""


@dataclass(frozen=True)
class Reliability:
    """Of the risk at seen grid points; the less the scores the better."""

    brier: float
    log_score: float
    grid_points: int
    bins: tuple[RiskBin, ...]

    def table(self) -> str:
        """Lines for people."""
        lines = [f"{'Risk':<14}  {'grid points':>11}  {'predicted':>9}  {'unsafe':>8}"]
        for b in self.bins:
            if b.grid_points:
                name = f"{100.0 * b.low:g} - {100.0 * b.high:g} %"
                shares = f"{100.0 * b.predicted:7.2f} %  {100.0 * b.unsafe:6.2f} %"
                lines.append(f"{name:<14}  {b.grid_points:11d}  {shares}")
        return "\n".join(lines)


def scores(risk: Array, failed: Mask) -> tuple[float, float]:
    """Brier score and mean log score of risks (K,)."""
    sure = np.clip(risk, LEAST, 1.0 - LEAST)
    log = -np.where(failed, np.log(sure), np.log1p(-sure)).mean()
    return float(np.square(risk - failed).mean()), float(log)


def reliability(risk: Array, failed: Mask) -> Reliability | None:
    """Of risks and what was true (any shape); None if nobody asked for risks.

    A risk of 1 is no prediction: there the lander would reach unseen ground.
    """
    told = np.isfinite(risk) & (risk < 1.0)
    if not told.any():
        return None
    given, true = risk[told], failed[told]
    bins = []
    for low, high in zip(EDGES, EDGES[1:], strict=False):
        here = (given >= low) & (given < high)
        shares = (given[here].mean(), true[here].mean()) if here.any() else (np.nan, np.nan)
        bins.append(RiskBin(low, high, int(here.sum()), float(shares[0]), float(shares[1])))
    return Reliability(*scores(given, true), int(told.sum()), tuple(bins))


def reliability_of(safety: SafetyField) -> Reliability | None:
    """Of the risk that a map gives to seen grid points; None if it gives none."""
    if safety.risk is None:
        return None
    return reliability(np.where(safety.seen, safety.risk, np.nan), ~safety.truly_safe)
