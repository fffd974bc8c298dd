# SPDX-License-Identifier: Apache-2.0
"""What the best place within reach is worth, at moments of simulated drone flights.

Flights of ``simulate drone`` with ``config/drone.yaml``; once a second, from the first, the place
that ``~/land_now`` would take. The lander stands there or does not, by the true ground; true is the
probability of a safe touchdown with the dispersion that the nodes are told. What waiting gained is
the computed probability of the best place 5 s later, less that of now.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import machine, table

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.desk.replay.replay import steps
from quadtree_lss.lab.campaign.mapped import in_memory
from quadtree_lss.lab.campaign.study import parse_seeds
from quadtree_lss.lab.evaluation.risk_flights import lander_of
from quadtree_lss.lab.simulation.simulation import Simulation
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.probability import Dispersion, aimed
from quadtree_lss.onboard.core.landing.sites import LandingSiteSelector
from quadtree_lss.onboard.core.landing.target import WAIT_S
from quadtree_lss.onboard.messages.maps import round_trip

PRESET = Path(__file__).parent.parent / "config" / "drone.yaml"
NEAR, PERIOD_S, RATE = 15.0, 1.0, 10


def main() -> None:
    """Print one table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="9431-9440", help="first-last")
    parser.add_argument("--rocks", type=float, help="share of the ground that they cover")
    options = parser.parse_args()
    print(machine())
    config = load_config([str(PRESET)])
    flown = [fly(seed, options.rocks, config) for seed in parse_seeds(options.seeds)]
    moments = np.concatenate(flown)
    wait = round(WAIT_S / PERIOD_S)
    gains = np.concatenate(
        [np.column_stack([f[:-wait, 2], f[wait:, 1] - f[:-wait, 1]]) for f in flown]
    )
    there, judged = moments[:, 0] > 0.0, np.isfinite(moments[:, 3])
    told, true = moments[judged][:, [1, 4]].mean(axis=0)
    rows = [
        ["moments", f"{len(moments)}"],
        [f"- with truly safe ground within {NEAR:g} m", f"{there.sum()}"],
        ["- of these, a place is named", f"{np.isfinite(moments[there, 1]).sum()}"],
        ["- it lies on ground whose truth is known", f"{judged.sum()}"],
        ["- the lander stands there", f"{int(moments[judged, 3].sum())}"],
        ["probability told, and true", f"{told:.4f}, {true:.4f}"],
        [
            f"gain of {WAIT_S:g} s told, and by the map then",
            "{:.4f}, {:.4f}".format(*np.nanmean(gains, 0)),
        ],
    ]
    table(f"{len(flown)} flights, seeds {options.seeds}", ["", "all flights"], rows)


def fly(seed: int, rocks: float | None, config: Config) -> Array:
    """Moments (N, 5): whether there is safe ground near, the probability told and the gain, whether
    the lander stands there, and the true probability."""
    simulation = Simulation("drone", seed, rocks=rocks)
    selector, moments, found = LandingSiteSelector(config), [], []
    for number, (scan, _, mapper) in enumerate(steps(in_memory(simulation), config)):
        if number % round(RATE * PERIOD_S):
            continue
        x, y, z = scan.pose.position.tolist()
        seen = selector.assess(round_trip(mapper.snapshot()), vehicle=(z, 1.0, x, y))
        found.append((seen.now.copy(), seen.gain, x, y))
    truth = simulation.truth("bag", lander_of(config))
    safe, step = truth["safe"], simulation.legs[0].plan.spacing
    spread = Dispersion.of(None, config.lss)
    stands = 1.0 - aimed(1.0 - safe.astype(float), step, spread)
    east, north = np.meshgrid(truth["safe_x"], truth["safe_y"])
    for (px, py, _, told), gain, x, y in found:
        near = bool((safe & (np.hypot(east - x, north - y) <= NEAR)).any())
        row, column = (
            int(np.abs(axis - at).argmin()) if np.isfinite(at) else 0
            for axis, at in ((truth["safe_y"], py), (truth["safe_x"], px))
        )
        known = np.isfinite(told) and abs(truth["safe_x"][column] - px) < step
        known = known and abs(truth["safe_y"][row] - py) < step
        fell = (float(safe[row, column]), stands[row, column]) if known else (np.nan, np.nan)
        moments.append((float(near), told, gain, *fell))
    return np.array(moments)


if __name__ == "__main__":
    main()
