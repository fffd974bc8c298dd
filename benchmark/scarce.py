# SPDX-License-Identifier: Apache-2.0
"""Closed-loop flights over ground of which only 3 to 10 % is safe.

Simulated fields have root mean square slopes of 6 to 12 degrees, with a tenth to a quarter of the
ground under rocks; each seed takes its first field with such a share of safe ground in the
candidate area. A flight counts if the area has a safe place with 1 m of clearance. A flight without
touchdown has climbed away.
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from itertools import starmap
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import machine, table

from quadtree_lss.lab.campaign.study import parse_seeds
from quadtree_lss.lab.flight.fly import fly_lockstep
from quadtree_lss.lab.flight.ground import Ground
from quadtree_lss.lab.flight.settings import FlightSettings
from quadtree_lss.lab.simulation.scenarios import Conditions

#: Range of the truly safe share of the candidate area; clearance that a flight needs to count, m.
SHARE, MIN_CLEARANCE = (0.03, 0.10), 1.0
#: Ranges of fields: root mean square slope, deg, and share of the ground under rocks.
SLOPES, ROCKS = (6.0, 12.0), (0.1, 0.25)


class Landing(NamedTuple):
    """Result of a flight: truly safe share of the ground, largest clearance, m, and outcome."""

    seed: int
    share: float
    clearance: float
    outcome: str
    safe: bool
    said: str

    @property
    def counts(self) -> bool:
        return self.clearance >= MIN_CLEARANCE

    @property
    def down(self) -> bool:
        return self.outcome == "touchdown"

    def __str__(self) -> str:
        end = f"{'safe' if self.safe else 'unsafe'}, map said {self.said}" if self.down else "-"
        ground = f"{100.0 * self.share:.1f} % safe, clearance {self.clearance:.2f} m"
        return f"seed {self.seed}: {ground}; {self.outcome}, {end}"


def main() -> None:
    """Print a line for each flight and a summary."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="98000-98023")
    parser.add_argument("--jobs", type=int, default=1, help="flights at once")
    options = parser.parse_args()
    print(machine())
    landings = []
    with ProcessPoolExecutor(options.jobs) as pool:
        for one in pool.map(land, parse_seeds(options.seeds)):
            landings.append(one)
            print(one, file=sys.stderr)
    parts = {f"with {MIN_CLEARANCE:g} m of clearance": [one for one in landings if one.counts]}
    parts["less clearance"] = [one for one in landings if not one.counts]
    table(
        f"{len(landings)} flights",
        ["in truth", "flights", "touchdowns", "safe", "unsafe", "share with a touchdown, %"],
        list(starmap(row, parts.items())),
    )


def land(seed: int) -> Landing:
    settings = FlightSettings()
    ground, share, clearance = scarce_ground(seed, settings)
    figures = fly_lockstep(seed, settings, ground=ground).figures
    outcome = figures["outcome"], figures["safe"], figures["map_said"]
    return Landing(seed, share, clearance, *outcome)


def scarce_ground(seed: int, settings: FlightSettings) -> tuple[Ground, float, float]:
    """Make a field; return it with its truly safe share and its largest clearance, m."""
    generator = np.random.default_rng(seed)
    while True:
        conditions = Conditions(
            rocks=generator.uniform(*ROCKS), slope_deg=generator.uniform(*SLOPES)
        )
        terrain = conditions.ground("morpheus", generator)
        planned = np.array([0.0, 0.0, float(terrain.elevation_at(0.0, 0.0))])
        ground = Ground(terrain, planned, settings.half)
        clearance = ground.safe[2]
        share = float(np.mean(clearance > 0.0))
        if SHARE[0] <= share <= SHARE[1]:
            return ground, share, float(clearance.max())


def row(name: str, some: list[Landing]) -> list[str]:
    down = [one for one in some if one.down]
    safe = sum(one.safe for one in down)
    part = f"{100.0 * len(down) / len(some):.0f}" if some else "-"
    return [name, str(len(some)), str(len(down)), str(safe), str(len(down) - safe), part]


if __name__ == "__main__":
    main()
