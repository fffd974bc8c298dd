# SPDX-License-Identifier: Apache-2.0
"""Ground that the drone preset calls safe at the ends of flights over simulated ground.

The flights last 8 to 40 s and start 15 to 31 m high, with scans at 10 Hz by wide and spinning
lidars of 4,000 to 33,000 beams. Only grid points are evaluated where all ground under the lander is
observed.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import configuration, machine, table
from scipy.ndimage import distance_transform_edt

from quadtree_lss.lab.campaign.study import parse_seeds
from quadtree_lss.lab.evaluation.risk_families import Family
from quadtree_lss.lab.evaluation.risk_fit import FEATURES
from quadtree_lss.lab.evaluation.risk_flights import fly, land
from quadtree_lss.lab.simulation.hazard_field import FIELDS
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.risk import risk_model
from quadtree_lss.onboard.config.settings import Config

GROUNDS = (*FIELDS, "mixed", "bare")
LIMITS = (0.002, 0.004, 0.006, 0.008, 0.012, 0.02, 0.05)
#: Smallest log10 of the number of returns per square clearance on well observed ground.
WELL_OBSERVED = 1.2
HEADER = ["judged, %", "unsafe, %", "kept of the safe, %", "called safe of the unsafe, %"]
HEADER += ["unsafe of what is called safe, %", "deepest, m"]


def main() -> None:
    """Print a row for each ground and for each `max_risk`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="94000-94026", help="dealt to the grounds in turn")
    options = parser.parse_args()
    config = configuration("drone")
    print(machine())
    flights: list[tuple[str, Array]] = []
    for number, seed in enumerate(parse_seeds(options.seeds)):
        ground = GROUNDS[number % len(GROUNDS)]
        flights.append((ground, evaluated(ground, seed, config)))
        print(f"seed {seed}, {ground}: {', '.join(row(flights[-1][1], config))}", file=sys.stderr)
    every = np.concatenate([of for _, of in flights], axis=1)
    well = [
        of for _, of in flights if np.mean(of[2] >= WELL_OBSERVED) > 0.5 * np.mean(of[2] > -np.inf)
    ]
    rows = [
        [name, *row(np.concatenate([of for kind, of in flights if kind == name], axis=1), config)]
        for name in dict.fromkeys(kind for kind, _ in flights)
    ]
    rows.append([f"{len(flights)} flights", *row(every, config)])
    if well:
        rows.append([f"{len(well)} that see well", *row(np.concatenate(well, axis=1), config)])
    table(f"max_risk {config.lss.max_risk:g}", ["ground", *HEADER], rows)
    header = ["max_risk", *HEADER[2:]]
    table("All flights", header, [[f"{t:g}", *row(every, config, t)[2:]] for t in LIMITS])


def evaluated(ground: str, seed: int, config: Config) -> Array:
    """Risk (NaN if not evaluated), depth in unsafe ground, m (0 if safe), and observation quality
    of grid points: (3, K)."""
    mapped = fly(Family(grounds=(ground,), views=("scanning",)), seed, config)[-1]
    landings = land(mapped, risk_model(""))
    risk, seen = np.full((2, *mapped.known.shape), np.nan)
    risk[landings.usable] = landings.risk
    seen[landings.usable] = landings.features[:, FEATURES.index("seen")]
    depth = distance_transform_edt(~mapped.safe) * mapped.cells.domain.finest_size
    return np.stack([risk, depth, seen])[:, mapped.known]


def row(points: Array, config: Config, limit: float | None = None) -> list[str]:
    """Figures as named by `HEADER`."""
    known = points[:, np.isfinite(points[0])]
    unsafe, called_safe = (
        known[1] > 0.0,
        known[0] <= (config.lss.max_risk if limit is None else limit),
    )
    missed = called_safe & unsafe
    shares = (
        np.isfinite(points[0]),
        unsafe,
        called_safe[~unsafe],
        called_safe[unsafe],
        unsafe[called_safe],
    )
    deepest = known[1][missed].max() if missed.any() else 0.0
    return [*(f"{100.0 * of.mean():.2f}" if of.size else "-" for of in shares), f"{deepest:.2f}"]


if __name__ == "__main__":
    main()
