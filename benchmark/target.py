# SPDX-License-Identifier: Apache-2.0
"""How well the target holds: its changes over simulated flights, judged by the true ground.

A change away from a target that is truly safe costs propellant for nothing unless the new one is
better in truth: its room, the distance to the nearest truly unsafe ground, must be greater.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import Recording, configuration, machine, recording, table
from scipy.ndimage import distance_transform_edt

from quadtree_lss.desk.replay.scans import scans
from quadtree_lss.lab.evaluation.results import Truth, load_truth
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.sites import LandingAssessment, LandingSiteSelector
from quadtree_lss.onboard.core.landing.target import Reason
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.messages.maps import round_trip

#: Scans between the maps of a flight: 20 Hz mapped, 4 Hz assessed.
EVERY = 5
#: The way to hold a site on the subscriber's side: the list's site within this of it, m.
HOLD = 2.0


def main() -> None:
    """Print one row a flight and their sums."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="541-544", help="first-last")
    parser.add_argument("--duration", type=float, help="s of each flight, by default all")
    parser.add_argument("--flights", type=Path, help="folder of <scenario>_<seed>/bag; or simulate")
    parser.add_argument("--scenario", default="morpheus")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="of lss")
    options = parser.parse_args()
    first, _, last = options.seeds.partition("-")
    changes = {
        f"lss__{key}": float(value) for key, _, value in (s.partition("=") for s in options.set)
    }
    config = configuration(options.scenario, **changes)
    print(machine())
    found = []
    for seed in range(int(first), int(last or first) + 1):
        found.append(fly(_flight(seed, config, options), config))
        print(found[-1].line(seed), flush=True)
    total = Tally()
    for one in found:
        total.add(one)
    table(
        f"{len(found)} flights: {total.assessments} assessments",
        ["", "changes", "from truly safe", "without gain", "m, mean", "m, greatest"],
        [[name, *total.of[name].row()] for name in total.of],
    )
    final = np.array([one.final for one in found])
    print(f"\nroom in truth of the last target: {np.mean(final):.2f} m, least {final.min():.2f} m")
    best = np.array([one.best for one in found])
    print(f"the best to be had: {best.mean():.2f} m; share, median {np.median(final / best):.0%}")


@dataclass
class Changes:
    """Changes of one kind."""

    count: int = 0
    safe: int = 0
    in_vain: int = 0
    moved: list[float] = field(default_factory=list)

    def note(self, before: Array, after: Array, truth: TrueRoom) -> None:
        """From one place to another (3,)."""
        self.count += 1
        self.safe += truth(before) > 0.0
        self.in_vain += truth(before) > 0.0 and truth(after) <= truth(before)
        self.moved.append(float(np.hypot(*(after - before)[:2])))

    def row(self) -> list[str]:
        """Cells of the table."""
        far = self.moved or [0.0]
        return [str(n) for n in (self.count, self.safe, self.in_vain)] + [
            f"{np.mean(far):.1f}",
            f"{max(far):.1f}",
        ]


KINDS = ("target, for a better one", "target, lost", "first of the list", "held from the list")


@dataclass
class Tally:
    """What was seen of one flight, or of many."""

    assessments: int = 0
    of: dict[str, Changes] = field(default_factory=lambda: {name: Changes() for name in KINDS})
    final: float = 0.0
    best: float = 0.0
    lost: list[str] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Sums."""
        self.assessments += other.assessments
        for name, changes in other.of.items():
            mine = self.of[name]
            mine.count += changes.count
            mine.safe += changes.safe
            mine.in_vain += changes.in_vain
            mine.moved += changes.moved

    def line(self, seed: int) -> str:
        """One flight."""
        counts = ", ".join(f"{name} {c.count} ({c.in_vain})" for name, c in self.of.items())
        return f"seed {seed}: {counts}; room {self.final:.1f} of {self.best:.1f} m {self.lost}"


class TrueRoom:
    """Distance of a place to truly unsafe ground, m; 0 on it and beyond what is known."""

    def __init__(self, truth: Truth) -> None:
        self._x, self._y = truth.safe_x, truth.safe_y
        self.step = float(self._x[1] - self._x[0])
        self.room = distance_transform_edt(np.pad(truth.safe, 1))[1:-1, 1:-1] * self.step

    def __call__(self, place: Array) -> float:
        column = int(np.rint((place[0] - self._x[0]) / self.step))
        row = int(np.rint((place[1] - self._y[0]) / self.step))
        inside = 0 <= row < len(self._y) and 0 <= column < len(self._x)
        return float(self.room[row, column]) if inside else 0.0


def fly(flight: Recording, config: Config) -> Tally:
    """A flight, assessed as it goes."""
    flown, truth = flight.scans, flight.truth
    room, tally = TrueRoom(truth), Tally()
    tally.best = float(room.room.max())
    mapper, selector = Mapper(config), LandingSiteSelector(config)
    target = first = held = None
    for number, scan in enumerate(flown, start=1):
        mapper.update(scan.points_lidar, scan.pose)
        if number % EVERY:
            continue
        found = selector.assess(round_trip(mapper.snapshot()))
        tally.assessments += 1
        target = _note_target(tally, found, target, room)
        ranked = found.sites.position
        if not len(ranked):
            continue
        if first is not None and np.hypot(*(ranked[0] - first)[:2]) > config.lss.vehicle.diameter:
            tally.of["first of the list"].note(first, ranked[0], room)
        first = ranked[0]
        if held is not None:
            away = np.hypot(*(ranked - held)[:, :2].T)
            if away.min() > HOLD:
                tally.of["held from the list"].note(held, ranked[0], room)
            held = ranked[np.argmin(away)] if away.min() <= HOLD else ranked[0]
        else:
            held = ranked[0]
    tally.final = 0.0 if target is None else room(target)
    return tally


def _note_target(
    tally: Tally, found: LandingAssessment, last: Array | None, room: TrueRoom
) -> Array | None:
    """The target of this assessment, or the last one while there is none after it."""
    chosen = found.selected
    if not chosen.id:
        if last is not None and chosen.reason != Reason.NO_SITE:
            tally.lost.append(f"{chosen.reason.key} {last[0]:.2f} {last[1]:.2f} {room(last):.2f}")
        return last
    if last is not None and chosen.reason == Reason.FIRST:
        tally.of["target, lost"].note(last, chosen.position, room)
    elif last is not None and chosen.reason == Reason.BETTER:
        tally.of["target, for a better one"].note(last, chosen.position, room)
    return chosen.position


def _flight(seed: int, config: Config, options: argparse.Namespace) -> Recording:
    if options.flights is None:
        return recording(options.scenario, seed, options.duration)
    at = options.flights / f"{options.scenario}_{seed}"
    return Recording(list(scans(at / "bag", config)), load_truth(at / "truth.npz"))


if __name__ == "__main__":
    main()
