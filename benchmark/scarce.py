# SPDX-License-Identifier: Apache-2.0
"""The closed loop over ground of which 3 to 10 % is safe: is a place found there?

Made fields of 6 to 12 degrees root mean square slope, a tenth to a quarter of them under rocks; of
a seed the first that has such a share of safe ground in the candidate area. A flight counts if
somewhere in that area the true ground is safe with 1 m of room all around. One without touchdown
has climbed away.
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
from quadtree_lss.lab.flight.fly import flown
from quadtree_lss.lab.flight.ground import Ground
from quadtree_lss.lab.flight.settings import FlightSettings
from quadtree_lss.lab.simulation.scenarios import Conditions

#: Share of the candidate area that is truly safe; room about a place that a flight counts for, m.
SHARE, ROOM = (0.03, 0.10), 1.0
#: What fields are drawn from: root mean square slope, degrees, and the share that rocks cover.
SLOPES, ROCKS = (6.0, 12.0), (0.1, 0.25)


class Landing(NamedTuple):
    """A flight: how much of its ground is safe, the greatest room there, m, and what came of it."""

    seed: int
    share: float
    room: float
    outcome: str
    safe: bool
    said: str

    @property
    def counts(self) -> bool:
        return self.room >= ROOM

    @property
    def down(self) -> bool:
        return self.outcome == "touchdown"

    def __str__(self) -> str:
        end = f"{'safe' if self.safe else 'unsafe'}, map said {self.said}" if self.down else "-"
        ground = f"{100.0 * self.share:.1f} % safe, room {self.room:.2f} m"
        return f"seed {self.seed}: {ground}; {self.outcome}, {end}"


def main() -> None:
    """Print a line a flight and their sums."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="98000-98059")
    parser.add_argument("--jobs", type=int, default=1, help="flights at once")
    options = parser.parse_args()
    print(machine())
    landings = []
    with ProcessPoolExecutor(options.jobs) as pool:
        for one in pool.map(land, parse_seeds(options.seeds)):
            landings.append(one)
            print(one, flush=True)
    parts = {f"with {ROOM:g} m of room": [one for one in landings if one.counts]}
    parts["less room"] = [one for one in landings if not one.counts]
    table(
        f"{len(landings)} flights",
        ["in truth", "flights", "touchdowns", "safe", "unsafe", "share that came down, %"],
        list(starmap(row, parts.items())),
    )


def land(seed: int) -> Landing:
    settings = FlightSettings()
    ground, share, room = scarce(seed, settings)
    figures = flown(seed, settings, ground=ground).figures
    came = figures["outcome"], figures["safe"], figures["map_said"]
    return Landing(seed, share, room, *came)


def scarce(seed: int, settings: FlightSettings) -> tuple[Ground, float, float]:
    """A field, the share of it that is safe, and the greatest room in it, m."""
    generator = np.random.default_rng(seed)
    while True:
        asked = Conditions(rocks=generator.uniform(*ROCKS), slope_deg=generator.uniform(*SLOPES))
        terrain = asked.ground("morpheus", generator)
        planned = np.array([0.0, 0.0, float(terrain.elevation_at(0.0, 0.0))])
        ground = Ground(terrain, planned, settings.half)
        room = ground.safe[2]
        share = float(np.mean(room > 0.0))
        if SHARE[0] <= share <= SHARE[1]:
            return ground, share, float(room.max())


def row(name: str, some: list[Landing]) -> list[str]:
    down = [one for one in some if one.down]
    safe = sum(one.safe for one in down)
    part = f"{100.0 * len(down) / len(some):.0f}" if some else "-"
    return [name, str(len(some)), str(len(down)), str(safe), str(len(down) - safe), part]


if __name__ == "__main__":
    main()
