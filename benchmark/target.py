# SPDX-License-Identifier: Apache-2.0
"""Changes of the target over simulated flights, compared with the true ground.

The flights are those of Morpheus, or with ``--drone`` of a drone that descends from 25 to 5 m in 20
s with its preset. The true probability of success uses the configured dispersion on the true
ground. A change for a better target is needless if it gains less than 0.4 %, a withdrawal if the
ground is truly safe. Changes after a withdrawal are not counted as changes for a better target.
``--bias`` compares the predicted gain of the first site over earlier first sites with the true
gain.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import configuration, machine, table

from quadtree_lss.desk.replay.replay import steps
from quadtree_lss.lab.campaign.flights import in_memory, lander_of
from quadtree_lss.lab.campaign.study import parse_seeds
from quadtree_lss.lab.simulation.hazard_field import FIELDS, hazard_field
from quadtree_lss.lab.simulation.safety import safety_map
from quadtree_lss.lab.simulation.scenarios import SCENARIOS
from quadtree_lss.lab.simulation.simulate import Leg, Simulation
from quadtree_lss.lab.simulation.trajectory import descent_trajectory
from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.aim import Dispersion, unsafe_aims
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.landing.result import LandingAssessment
from quadtree_lss.onboard.core.landing.target import Reason, State
from quadtree_lss.onboard.messages.maps import round_trip

#: Scans between assessed maps and their period, s: at 20 Hz, and at 10 Hz for a drone.
MORPHEUS, DRONE = (5, 0.25), (2, 0.2)
#: Initial and final height of a drone, m, and duration of its descent, s.
HEIGHTS, DURATION = (25.0, 5.0), 20.0
#: Smallest distance of a change, m; time before commitment or the end of the flight from which a
#: change is late, s; smallest useful gain of true probability.
MIN_MOVE, LATE_S, MIN_GAIN = 1.0, 8.0, 0.004
#: Reasons of withdrawals because of the ground.
WITHDRAWAL_REASONS = (Reason.HAZARD, Reason.UNSEEN, Reason.UNMAPPED, Reason.UNLIKELY)
#: Bounds of the bins of predicted risk, with ``--predicted``.
RISK_EDGES = (0.0, 0.001, 0.003, 0.01, 0.03, 0.1)
#: Bounds of the bins of predicted gain, with ``--bias``.
GAIN_EDGES = (0.0, 0.001, 0.004, 0.01, 0.02, 0.04, 0.1)


def main() -> None:
    """Print a line for each flight and a summary."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="541-547", help="first-last; fields take turns")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="of lss")
    parser.add_argument("--drone", action="store_true", help="a drone's flights, with its preset")
    text = "risks of the safest aims: predicted, at the end, true"
    parser.add_argument("--predicted", action="store_true", help=text)
    parser.add_argument("--bias", action="store_true", help="gains: predicted and true")
    options = parser.parse_args()
    changes = {
        f"lss__{key}": float(value) for key, _, value in (s.partition("=") for s in options.set)
    }
    config = configuration("drone" if options.drone else "morpheus", **changes)
    print(machine())
    flights = []
    for seed in parse_seeds(options.seeds):
        name = list(FIELDS)[seed % len(FIELDS)]
        flown = drone(seed, name) if options.drone else morpheus(seed, name)
        flights.append(fly(flown, config, *(DRONE if options.drone else MORPHEUS)))
        print(f"seed {seed}, {name}: {len(flights[-1].moves)} changes", file=sys.stderr)
    n = len(flights)
    moves = [move for flight in flights for move in flight.moves]
    lost = [move for flight in flights for move in flight.lost]
    missed = np.array([flight.first_site - flight.last for flight in flights])
    late = sum(m.time > f.end - LATE_S for f in flights for m in f.moves)
    table(
        f"{n} flights",
        ["", "a flight"],
        [
            [f"changes over {MIN_MOVE:g} m", f"{len(moves) / n:.2f}"],
            [f"- in the last {LATE_S:g} s before commitment or the end", f"{late / n:.2f}"],
            [
                f"- for less than {MIN_GAIN:.1%} of true probability",
                f"{sum(m.is_needless for m in moves) / n:.2f}",
            ],
            ["withdrawals from truly safe ground", f"{sum(m.safe for m in lost) / n:.2f}"],
            ["withdrawals from truly unsafe ground", f"{sum(not m.safe for m in lost) / n:.2f}"],
            ["first target after, s", f"{np.mean([f.first for f in flights]):.1f}"],
            ["last target's true probability", f"{np.mean([f.last for f in flights]):.4f}"],
            ["the first site's", f"{np.mean([f.first_site for f in flights]):.4f}"],
            ["the best grid point's", f"{np.mean([f.best for f in flights]):.4f}"],
            ["below the first site's, mean and most", f"{missed.mean():.4f}, {missed.max():.4f}"],
        ],
    )
    if options.predicted:
        _print_risks(np.concatenate([flight.risks for flight in flights]))
    if options.bias:
        _print_gains(np.concatenate([flight.gains for flight in flights]))


@dataclass(frozen=True)
class Move:
    """A change of the target or a withdrawal: time, s, distance, m, and gain of true probability.
    ``safe``: the abandoned target was truly safe; ``follows``: the change follows a withdrawal."""

    time: float
    distance: float
    gain: float
    safe: bool
    follows: bool = False

    @property
    def is_needless(self) -> bool:
        """Whether the change gains almost nothing, without a withdrawal before it."""
        return self.gain < MIN_GAIN and not self.follows


@dataclass
class Tally:
    """Figures of one flight. ``first``: time of the first target, s; ``end``: of commitment, or of
    the end; ``last``, ``first_site``, ``best``: true probability of the last target, of the first
    site, and of the best grid point in the scanned area; ``risks``: (K, 3) risk of the safest aims
    as predicted, as predicted at the end, and in truth; ``gains``: (K, 2) predicted and true."""

    moves: list[Move] = field(default_factory=list)
    lost: list[Move] = field(default_factory=list)
    first: float = float("nan")
    last: float = 0.0
    end: float = float("nan")
    first_site: float = 0.0
    best: float = 0.0
    risks: Array = field(default_factory=lambda: np.empty((0, 3)))
    gains: Array = field(default_factory=lambda: np.empty((0, 2)))


class Truth:
    """True safety and probability of success on the grid of an assessment (ny, nx); ``best`` is the
    highest probability in the scanned area."""

    def __init__(self, simulation: Simulation, found: LandingAssessment, config: Config) -> None:
        dem, lander = simulation.legs[0].plan.terrain, lander_of(config)
        self.x, self.y = found.x, found.y
        self.safe: Mask = safety_map(dem, self.x, self.y, lander)
        spread = Dispersion.from_values(None, config.lss)
        self.probability = 1.0 - unsafe_aims(
            1.0 - self.safe.astype(float), config.lss.spacing, spread
        )
        xmin, xmax, ymin, ymax = simulation.legs[0].plan.box
        rows, columns = (self.y >= ymin) & (self.y <= ymax), (self.x >= xmin) & (self.x <= xmax)
        self.best = float(self.probability[np.ix_(rows, columns)].max())

    def at(self, place: Array) -> tuple[int, int]:
        """Row and column."""
        return int(np.abs(self.y - place[1]).argmin()), int(np.abs(self.x - place[0]).argmin())


def morpheus(seed: int, name: str) -> Simulation:
    """Make a flight over a field."""
    terrain = hazard_field(np.random.default_rng([seed, 1]), FIELDS[name])
    return Simulation("morpheus", seed, terrain=terrain)


def drone(seed: int, name: str) -> Simulation:
    """Make a flight of a drone over a scaled field."""
    made = hazard_field(np.random.default_rng([seed, 1]), FIELDS[name])
    terrain = made.scaled(SCENARIOS["drone"].scale)
    simulation = Simulation("drone", seed, terrain=terrain, duration=DURATION)
    plan, start_ns = simulation.legs[0].plan, simulation.legs[0].start_ns
    xmin, xmax, ymin, ymax = plan.box
    x, y = 0.5 * (xmin + xmax), 0.5 * (ymin + ymax)
    centre = (x, y, float(terrain.elevation_at(x, y)))
    down = descent_trajectory(centre, DURATION, *HEIGHTS)
    simulation.legs[0] = Leg(replace(plan, trajectory=down), start_ns)
    return simulation


def fly(simulation: Simulation, config: Config, every: int, period: float) -> Tally:
    """Fly and assess after every ``every`` scans, ``period`` s."""
    selector, tally, truth = LandingSiteSelector(config), Tally(), None
    target, was_withdrawn = None, False
    before = (float("nan"), float("nan"))
    predicted: list[tuple[tuple[int, int], float]] = []
    gains: list[tuple[float, float]] = []
    first_sites: set[tuple[int, int]] = set()
    for number, (scan, _, mapper) in enumerate(steps(in_memory(simulation), config), start=1):
        if number % every:
            continue
        now, height = period * (number // every), float(scan.pose.position[2])
        down = (before[1] - height) / (now - before[0]) if before[0] > 0.0 else 0.0
        before = now, height
        found = selector.assess(
            round_trip(mapper.snapshot()), vehicle=(height, down), waited=now - period
        )
        if truth is None:
            truth = Truth(simulation, found, config)
            tally.best = truth.best
        predicted += [(at, 1.0 - found.probability[at]) for at in _safest_aims(found)]
        chosen = found.selected
        if chosen.state is State.COMMITTED and np.isnan(tally.end):
            tally.end = now
        if len(found.sites) and np.isnan(tally.end):
            site = truth.at(found.sites.position[0])
            tally.first_site = float(truth.probability[site])
            gains += _gains(found, truth, site, first_sites)
            first_sites.add(site)
        if chosen.id:
            if target is None:
                tally.first = now
            elif np.hypot(*(chosen.position - target)[:2]) > MIN_MOVE:
                move = _move(now, target, chosen.position, truth)
                tally.moves.append(replace(move, follows=was_withdrawn))
            target, was_withdrawn = chosen.position, False
        elif target is not None and not was_withdrawn and chosen.reason in WITHDRAWAL_REASONS:
            was_withdrawn = True
            tally.lost.append(_move(now, target, target, truth))
    assert truth is not None
    tally.end = now if np.isnan(tally.end) else tally.end
    tally.gains = np.array(gains).reshape(-1, 2)
    tally.last = 0.0 if target is None else float(truth.probability[truth.at(target)])
    end = 1.0 - found.probability
    tally.risks = np.array([(r, end[at], 1.0 - truth.probability[at]) for at, r in predicted])
    return tally


def _gains(
    found: LandingAssessment, truth: Truth, site: tuple[int, int], before: set[tuple[int, int]]
) -> list[tuple[float, float]]:
    """Predicted and true gains of the first site over permitted points that were first sites
    before."""
    pairs = []
    for target in before - {site}:
        predicted = float(found.probability[site] - found.probability[target])
        if np.isfinite(found.score[target]) and predicted > 0.0:
            pairs.append((predicted, float(truth.probability[site] - truth.probability[target])))
    return pairs


def _move(now: float, start: Array, end: Array, truth: Truth) -> Move:
    a, b = truth.at(start), truth.at(end)
    gain = float(truth.probability[b] - truth.probability[a])
    return Move(now, float(np.hypot(*(end - start)[:2])), gain, bool(truth.safe[a]))


def _safest_aims(found: LandingAssessment) -> list[tuple[int, int]]:
    """Safest aim in each square of 8 m that has one."""
    value = np.where(found.safe, found.probability, 0.0)
    side = max(round(8.0 / (found.x[1] - found.x[0])), 1)
    places = []
    for row in range(0, len(found.y), side):
        for column in range(0, len(found.x), side):
            part = value[row : row + side, column : column + side]
            if part.max() >= 1.0 - RISK_EDGES[-1]:
                i, j = divmod(int(np.argmax(part)), part.shape[1])
                places.append((row + i, column + j))
    return places


def _print_risks(risks: Array) -> None:
    rows = []
    for low, high in zip(RISK_EDGES, RISK_EDGES[1:], strict=False):
        some = risks[(risks[:, 0] >= low) & (risks[:, 0] < high)]
        if len(some):
            off = np.sqrt(np.mean((some[:, 1:] - some[:, :1]) ** 2, axis=0))
            rows.append(
                [f"{low:g} to {high:g}", str(len(some))]
                + [f"{v:.4f}" for v in (*some.mean(axis=0), *off)]
                + [f"{off[1] / some[:, 0].mean():.2f}"]
            )
    heads = ["risk", "aims", "predicted", "at the end", "true", "end off by", "truth off by"]
    table("the safest aims of 8 m squares", [*heads, "share"], rows)


def _print_gains(gains: Array) -> None:
    rows = []
    for low, high in zip(GAIN_EDGES, GAIN_EDGES[1:], strict=False):
        some = gains[(gains[:, 0] >= low) & (gains[:, 0] < high)]
        if len(some):
            mean = some.mean(axis=0)
            means = (f"{v:.4f}" for v in mean)
            rows.append(
                [f"{low:g} to {high:g}", str(len(some)), *means, f"{mean[1] / mean[0]:.2f}"]
            )
    share = float(gains[:, 0] @ gains[:, 1] / (gains[:, 0] @ gains[:, 0]))
    heads = ["predicted gain", "pairs", "predicted", "true", "ratio"]
    table(f"the best over those before: {share:.2f} of the predicted gain is true", heads, rows)


if __name__ == "__main__":
    main()
