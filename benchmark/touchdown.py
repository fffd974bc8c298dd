# SPDX-License-Identifier: Apache-2.0
"""Static contact against touchdowns with legs: how often they differ, where, and how fast.

Places on made fields, three of four where the lander stands by the static contact at every heading.
Speeds, tilts, turns and misses as guidance leaves them (`fly`), up to what counts as soft, and
harder. Friction is drawn from 0.3 to 0.9, headings from all. With `--told` places of simulated
flights by the risk that the map gives to them.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import configuration, machine, table

from quadtree_lss.lab.campaign.mapped import fly_in_memory
from quadtree_lss.lab.campaign.summary import rate_interval
from quadtree_lss.lab.evaluation.metrics import EDGES
from quadtree_lss.lab.simulation.hazard_field import FIELDS, HazardField, hazard_field
from quadtree_lss.lab.simulation.safety import contact_safe, worst_contact
from quadtree_lss.lab.simulation.terrain import Terrain
from quadtree_lss.lab.touchdown.legs import DRONE, LANDER, Legs
from quadtree_lss.lab.touchdown.touchdown import OUTCOMES, Arrival, engine, touch
from quadtree_lss.onboard.arrays import Array

BARE = HazardField(rock_abundance=0.0, piles=0.0, craters=0.0)
MARS, MOON = 3.71, 1.62
GROUNDS = {
    "flat with rocks": (replace(FIELDS["rocky"], slope_rms_deg=0.5, craters=0.0), MOON),
    "slopes": (replace(BARE, slope_rms_deg=6.0), MOON),
    "craters": (replace(BARE, craters=24e-3), MOON),
    "Mars-like": (replace(BARE, rock_abundance=0.12, slope_rms_deg=3.0, texture=0.02), MARS),
    "rough": (FIELDS["rough"], MOON),
}
SPEEDS = ("as guided", "soft", "hard")
"""Across, down, m/s, tilt and turn, degrees and per second, at most; see `arrival`."""
MOST = {"soft": (0.5, 2.0, 6.0, 10.0), "hard": (1.5, 3.0, 12.0, 20.0)}
RISES = (0.33, 0.5, 0.67, 0.83, 1.0)
MISS = 0.1
PER_FIELD = 20


@dataclass(frozen=True)
class Touched:
    """A touchdown: where, how, what the static contact says (slope as a tangent, rise in m), and
    what became of it."""

    ground: str
    speeds: str
    seed: int
    number: int
    x: float
    y: float
    across: float
    down: float
    tilt_deg: float
    friction: float
    slope: float
    rise: float
    outcome: str
    end_tilt_deg: float
    slid: float
    stroke: float
    gained: float
    risk: float = float("nan")

    def safe(self, legs: Legs) -> bool:
        """By the static contact."""
        gear = legs.gear
        return self.slope <= np.tan(np.radians(gear.max_slope_deg)) and (
            self.rise <= gear.max_roughness
        )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--touchdowns", type=int, default=2000, help="on all grounds")
    parser.add_argument("--seed", type=int, default=95000, help="of the first field")
    parser.add_argument("--speeds", choices=SPEEDS, help="these alone")
    text = "of the vehicle, over its own, for instance lift=0.25"
    parser.add_argument("--legs", action="append", default=[], metavar="KEY=VALUE", help=text)
    parser.add_argument("--drone", action="store_true", help="on skids, over fields of its size")
    parser.add_argument("--told", type=int, default=0, help="simulated flights whose risks to try")
    parser.add_argument("--out", type=Path, help="all touchdowns, a line of JSON each")
    options = parser.parse_args()
    engine()
    print(machine())
    changed = (text.partition("=") for text in options.legs)
    own = {name: float(value) for name, _, value in changed}
    legs = replace(DRONE if options.drone else LANDER, **own)
    speeds = (options.speeds,) if options.speeds else SPEEDS
    if options.told:
        done = [one for k in range(options.told) for one in told(options.seed + k, legs)]
        reliability(done, legs)
    else:
        fields = max(round(options.touchdowns / (len(GROUNDS) * PER_FIELD)), 1)
        done = [
            one
            for k in range(fields)
            for number, name in enumerate(GROUNDS)
            for one in on_field(name, options.seed + k * len(GROUNDS) + number, legs, speeds)
        ]
        judged(done, legs, speeds)
        by_speed(done, legs)
        limits(done, legs)
    if options.out:
        options.out.write_text("".join(json.dumps(asdict(one)) + "\n" for one in done))


def on_field(name: str, seed: int, legs: Legs, speeds: Sequence[str]) -> Iterator[Touched]:
    """Touchdowns on one field; its size goes with the vehicle's, its gravity is the ground's but
    for a drone."""
    generator = np.random.default_rng(seed)
    field, gravity = GROUNDS[name]
    made, scale = hazard_field(generator, field), legs.gear.diameter / LANDER.gear.diameter
    terrain = made.scaled(scale)
    legs = legs if legs.skids else replace(legs, gravity=gravity)
    half = terrain.x[-1] - 3.0 * legs.gear.diameter
    places = generator.uniform(-half, half, (40 * PER_FIELD, 2))
    stands = contact_safe(terrain, places, legs.gear)
    aims = np.concatenate([places[stands][: 3 * PER_FIELD // 4], places[~stands]])[:PER_FIELD]
    for number, aim in enumerate(aims):
        how = speeds[number % len(speeds)]
        place = aim + scale * generator.normal(0.0, MISS, 2)
        yield touched(generator, terrain, legs, place, how, (name, how, seed, number))


def touched(
    generator: np.random.Generator,
    terrain: Terrain,
    legs: Legs,
    place: Array,
    how: str,
    named: tuple[str, str, int, int],
    risk: float = float("nan"),
) -> Touched:
    """One touchdown at a place (2,)."""
    legs = replace(legs, friction=float(generator.uniform(0.3, 0.9)))
    came = arrival(generator, place, how)
    ((slope,), (rise,)) = worst_contact(terrain, place[None], legs.gear)
    found = touch(legs, terrain, came)
    across, down = float(np.hypot(*came.velocity[:2])), -float(came.velocity[2])
    tilt = float(np.degrees(np.arccos(came.up[2])))
    stood = found.outcome, found.tilt_deg, found.slid, found.stroke, found.gained, risk
    came_with = across, down, tilt, legs.friction, float(slope), float(rise)
    return Touched(*named, *place.tolist(), *came_with, *stood)


def arrival(generator: np.random.Generator, place: Array, how: str) -> Arrival:
    """As guidance leaves it, by the records of `fly` (0.02 m/s across, 1.2 down, 0.4 degrees, turns
    of 10 degrees/s now and then); or uniform up to a most."""
    if how == "as guided":
        across, down = 0.017 * generator.rayleigh(), generator.normal(1.19, 0.03)
        tilt_deg, turn_deg = 0.35 * generator.rayleigh(), generator.choice([0.0, 10.0])
    else:
        across, down, tilt_deg, turn_deg = generator.uniform(0.0, MOST[how])
        down = max(down, 0.5)
    ways = generator.uniform(0.0, 2.0 * np.pi, 4)
    out = np.stack([np.cos(ways), np.sin(ways), np.zeros(4)], axis=1)
    lean = np.radians(tilt_deg)
    return Arrival(
        *place.tolist(),
        across * out[0] - [0.0, 0.0, down],
        np.sin(lean) * out[1] + [0.0, 0.0, np.cos(lean)],
        float(ways[2]),
        np.radians(turn_deg) * out[3],
    )


def share(events: int, of: int) -> str:
    """Percent with a 95 % interval (Clopper-Pearson)."""
    if not of:
        return "-"
    low, high = rate_interval(events, of)
    return f"{100.0 * events / of:.2f} ({100.0 * low:.2f}-{100.0 * high:.2f})"


def fails(done: Sequence[Touched]) -> int:
    """How many do not stand."""
    return sum(one.outcome != OUTCOMES[0] for one in done)


def judged(done: Sequence[Touched], legs: Legs, speeds: Sequence[str]) -> None:
    """Static against dynamic, by ground and speed."""
    rows = []
    for ground in (*GROUNDS, None):
        for how in speeds:
            here = [t for t in done if ground in (None, t.ground) and t.speeds == how]
            safe = [t for t in here if t.safe(legs)]
            unsafe = [t for t in here if not t.safe(legs)]
            counts = [sum(t.outcome == what for t in safe) for what in OUTCOMES[1:]]
            stand = len(unsafe) - fails(unsafe)
            rows.append([ground or "all", how, len(safe), *counts, share(fails(safe), len(safe))])
            rows[-1] += [len(unsafe), share(stand, len(unsafe))]
    header = ["ground", "speeds", "static safe", *OUTCOMES[1:], "do not stand, %"]
    gains = f"energy gained at most {100.0 * max(t.gained for t in done):.1f} %"
    table(
        f"{len(done)} touchdowns, {gains}",
        [*header, "static unsafe", "stand all the same, %"],
        rows,
    )


def by_speed(done: Sequence[Touched], legs: Legs) -> None:
    """Of the static-safe ones, by the speeds."""
    rows = []
    safe = [t for t in done if t.safe(legs)]
    for low, high in ((0.0, 0.1), (0.1, 0.3), (0.3, 0.5), (0.5, 1.0), (1.0, 1.5)):
        cells = []
        for least, most in ((0.0, 1.5), (1.5, 2.0), (2.0, 3.0)):
            here = [t for t in safe if low <= t.across < high and least <= t.down < most]
            cells += [len(here), share(fails(here), len(here))]
        rows.append([f"{low:g}-{high:g}", *cells])
    header = ["across, m/s", "to 1.5 m/s down", "%", "to 2", "%", "to 3", "%"]
    table("Static safe, do not stand, by speed", header, rows)


def limits(done: Sequence[Touched], legs: Legs) -> None:
    """Limits of slope and of rise, and what is left below both; at every speed that is soft."""
    soft = [t for t in done if t.speeds != "hard" and t.across <= 0.5]
    rows = []
    for slope_deg in (4.0, 6.0, 8.0, 10.0, 12.0, 15.0, 20.0):
        cells = []
        for share_of in RISES:
            steep, high = np.tan(np.radians(slope_deg)), share_of * legs.gear.max_roughness
            here = [t for t in soft if t.slope <= steep and t.rise <= high]
            cells.append(f"{fails(here)} of {len(here)}")
        rows.append([f"{slope_deg:g}", *cells])
    header = ["slope to, degrees", *(f"rise to {r:.2g} c" for r in RISES)]
    table("Do not stand, of all guided and soft ones within limits", header, rows)


def told(seed: int, legs: Legs) -> Iterator[Touched]:
    """Touchdowns at places of a simulated flight of `morpheus`, as many of each bin of risk."""
    generator = np.random.default_rng(seed)
    rocks, slope_deg = (float(generator.choice(v)) for v in ((0.02, 0.05, 0.1), (1.5, 4.0, 6.0)))
    given = {"rocks": rocks, "slope_deg": slope_deg}
    results, truth = fly_in_memory("morpheus", seed, configuration("morpheus"), given)
    grid = results.grid
    risk = np.asarray(grid.layers["risk"])
    for low, high in zip(EDGES, EDGES[1:], strict=False):
        rows, columns = np.nonzero((risk >= low) & (risk < high))
        chosen = generator.permutation(len(rows))[:20]
        for number, k in enumerate(chosen):
            place = np.array([grid.x[columns[k]], grid.y[rows[k]]])
            value, named = float(risk[rows[k], columns[k]]), ("flown", SPEEDS[0], seed, number)
            yield touched(generator, truth, legs, place, SPEEDS[0], named, value)


def reliability(done: Sequence[Touched], legs: Legs) -> None:
    """The given risk against static and dynamic failure."""
    rows = []
    for low, high in zip(EDGES, EDGES[1:], strict=False):
        here = [t for t in done if low <= t.risk < high]
        if here:
            static = share(sum(not t.safe(legs) for t in here), len(here))
            given = f"{100.0 * np.mean([t.risk for t in here]):.2f}"
            name = f"{100.0 * low:g}-{100.0 * high:g}"
            rows.append([name, len(here), given, static, share(fails(here), len(here))])
    header = ["risk, %", "touchdowns", "given, %", "static unsafe, %", "do not stand, %"]
    table(f"{len(done)} touchdowns, as guided", header, rows)


if __name__ == "__main__":
    main()
