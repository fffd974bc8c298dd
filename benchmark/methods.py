# SPDX-License-Identifier: Apache-2.0
"""The paper's fit, pose covariance and division on the same flights: why defaults are so."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import MapScore, configuration, machine, recording, score, table

from quadtree_lss.lab.evaluation.consistency import Counts

METHODS = ("none", "fit", "covariance", "division", "all")


def main() -> None:
    """Print one table for each flight."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parabola", type=int, nargs="*", default=[101, 102], help="seeds")
    parser.add_argument("--morpheus", type=int, nargs="*", default=[101], help="seeds")
    parser.add_argument("--duration", type=float, help="s of each flight, by default all")
    options = parser.parse_args()
    print(machine())
    for scenario, seeds in (("parabola", options.parabola), ("morpheus", options.morpheus)):
        if seeds:
            compare(scenario, seeds, options.duration)


def compare(scenario: str, seeds: list[int], duration: float | None) -> None:
    """All methods on the flights of one scenario."""
    scores: dict[str, list[MapScore]] = {method: [] for method in METHODS}
    for seed in seeds:
        flight = recording(scenario, seed, duration)
        for method in METHODS:
            config = configuration(scenario, mapping__paper=method)
            scores[method].append(score(flight, config))
        recording.cache_clear()
    table(
        f"{scenario}, seeds {' '.join(map(str, seeds))}: means; max, hazards: the worst flight's",
        ["by the paper", "leaves", "mean m", "RMS* m", "max m", "below %", "above %"]
        + ["median ms", "all s", "hazards %", "safe %", "unsafe"],
        [row(method, of) for method, of in scores.items()],
    )
    print("RMS*: of the elevation error, mean removed; below, above: prefit, one degree;")
    print("unsafe: truly unsafe sites among the first five of each flight")


def row(method: str, of: list[MapScore]) -> list[str]:
    """One line of the table."""
    counts = sum((s.counts for s in of), Counts()).one_degree
    errors = [s.elevation for s in of]
    return [
        method,
        f"{np.mean([s.leaves for s in of]):.0f}",
        f"{np.mean([e.mean_absolute for e in errors]):.3f}",
        f"{np.mean([e.rms_mean_removed for e in errors]):.3f}",
        f"{max(e.maximum for e in errors):.2f}",
        f"{100.0 * counts.below:.2f}",
        f"{100.0 * counts.above:.2f}",
        f"{np.mean([np.median(s.scan_ms) for s in of]):.2f}",
        f"{np.mean([s.seconds for s in of]):.2f}",
        f"{100.0 * min(s.detection.hazardous_found for s in of):.2f}",
        f"{100.0 * np.mean([s.detection.safe_found for s in of]):.1f}",
        f"{sum(s.unsafe_in_top_five for s in of)}",
    ]


if __name__ == "__main__":
    main()
