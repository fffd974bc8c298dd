# SPDX-License-Identifier: Apache-2.0
"""What a prior gives a flight: the same flights without one, with a right one and with a level one.

Ground is a measured terrain with rocks of its own strewn on it, which no prior holds. The right
prior is that terrain's every post of 2 m, with 0.5 m of noise and shifted by 8 m east or north, one
sigma each; the level one knows nothing, so that what a first look at little ground gives alone can
be told apart.

True is the probability of a safe touchdown with the dispersion that guidance states, over the true
ground. A flight has its first target when one is named whose true probability is no less than
`EQUAL` below that of the first target of the same flight without a prior.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import machine, table

from quadtree_lss.lab.campaign.study import parse_seeds
from quadtree_lss.lab.flight.fly import flown
from quadtree_lss.lab.flight.ground import Ground
from quadtree_lss.lab.flight.settings import FlightSettings, flight_settings
from quadtree_lss.lab.simulation.safety import contact_safe
from quadtree_lss.lab.simulation.terrain import load_terrain
from quadtree_lss.onboard.arrays import Array

SPACING, NOISE, SHIFT, HIGH = 2.0, 0.5, 8.0, 3.0
EQUAL = 0.01
Made = Callable[[FlightSettings, np.random.Generator, Path], dict[str, Any]]


@dataclass(frozen=True)
class Flown:
    """A flight: figures, its targets (T, 4) as time, x, y and true probability, and the offset of
    the prior as it was found, with its deviation and the truth, (3, 3) m, None without."""

    figures: dict[str, Any]
    targets: Array
    offset: Array | None

    def first(self, least: float) -> float:
        """When the first target came that is truly so good, s."""
        good = self.targets[self.targets[:, 3] >= least]
        return float(good[0, 0]) if len(good) else np.inf


def right(settings: FlightSettings, generator: np.random.Generator, path: Path) -> dict[str, Any]:
    """The terrain itself, degraded."""
    terrain = load_terrain(settings.terrain)
    xmin, xmax, ymin, ymax = terrain.bounds
    x, y = np.arange(xmin, xmax, SPACING), np.arange(ymin, ymax, SPACING)
    east, north = generator.normal(0.0, SHIFT, 2)
    up = generator.normal(0.0, HIGH)
    at = np.clip(x + east, xmin, xmax), np.clip(y + north, ymin, ymax)
    z = terrain.elevation_at(*np.meshgrid(*at)) - up
    np.savez(path, x=x, y=y, elevation=z + generator.normal(0.0, NOISE, z.shape))
    return {"true": np.array([east, north, up])}


def level(settings: FlightSettings, generator: np.random.Generator, path: Path) -> dict[str, Any]:
    """A prior that knows nothing."""
    terrain = load_terrain(settings.terrain)
    z = np.full(terrain.elevation.shape, np.median(terrain.elevation))
    np.savez(path, x=terrain.x, y=terrain.y, elevation=z)
    return {}


PRIORS: dict[str, Made] = {"right": right, "level": level}


def fly(seed: int, values: dict[str, Any], make: Made | None) -> Flown:
    """One flight."""
    settings = flight_settings(values)
    with tempfile.TemporaryDirectory() as folder:
        told: dict[str, Any] = {}
        if make is not None:
            path = Path(folder, "prior.npz")
            told = make(settings, np.random.default_rng([seed, 1]), path)
            prior = {"file": str(path), "sigma": NOISE, "offset_sigma": SHIFT, "height_sigma": HIGH}
            config = {f"prior.{key}": value for key, value in prior.items()}
            settings = flight_settings(values | {"config": config})
        done = flown(seed, settings)
    targets = [
        (d.time, d.x, d.y, true_probability(done.flight.ground, d.x, d.y, settings))
        for d in done.flight.pilot.decisions
        if d.what in ("target", "divert")
    ]
    found = done.prior
    offset = None
    if found is not None and not found.refused and "true" in told:
        offset = np.array([found.offset, np.sqrt(found.covariance.diagonal()), told["true"]])
    return Flown(done.figures, np.array(targets).reshape(-1, 4), offset)


def true_probability(ground: Ground, x: float, y: float, settings: FlightSettings) -> float:
    """Of a safe touchdown by an aim."""
    step = np.arange(-2.0, 2.01, 0.25)
    dx, dy = (axis.ravel() for axis in np.meshgrid(step, step))
    weight = np.exp(-(dx**2 + dy**2) / (2.0 * settings.rules.miss**2))
    stands = contact_safe(ground.terrain, np.column_stack([x + dx, y + dy]))
    return float(weight @ stands / weight.sum())


def steep_start(seed: int, values: dict[str, Any]) -> bool:
    """Whether a flight's planned point lies on ground that is mostly steep, with even ground in its
    area: where a prior has something to tell. By posts of the terrain, without rocks."""
    settings = flight_settings(values)
    field = np.random.default_rng(np.random.SeedSequence(seed).spawn(4)[0])
    x, y, _ = Ground.of(settings, field).planned
    terrain = load_terrain(settings.terrain)
    step = np.arange(-24.0, 24.1, SPACING)
    along_y, along_x = np.gradient(terrain.elevation_at(*np.meshgrid(x + step, y + step)), SPACING)
    steep = np.degrees(np.arctan(np.hypot(along_x, along_y))) > 10.0
    near = np.abs(step) <= 12.0
    return bool(steep[np.ix_(near, near)].mean() > 0.6 and steep.mean() < 0.75)


def main() -> None:
    """Print one row a flight and what they come to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--terrain", help=".npz with x, y, elevation; without it nothing is flown")
    parser.add_argument("--rocks", type=float, default=0.05)
    parser.add_argument("--seeds", default="43100-43139", help="first-last")
    parser.add_argument("--priors", nargs="*", default=list(PRIORS), choices=list(PRIORS))
    parser.add_argument("--east-of", type=float, metavar="X", help="of the terrain, m: no more")
    text = "fly only the first so many where the planned point is steep and even ground is near"
    parser.add_argument("--steep", type=int, metavar="N", help=text)
    parser.add_argument("--longest", type=float, default=150.0, help="end flights after so long, s")
    options = parser.parse_args()
    if options.terrain is None:
        print(f"nothing flown: --terrain names no ground; {machine()}")
        return
    if options.east_of is not None:
        whole, kept = load_terrain(options.terrain), Path(tempfile.mkdtemp(), "terrain.npz")
        part = whole.x >= options.east_of
        np.savez(kept, x=whole.x[part], y=whole.y, elevation=whole.elevation[:, part])
        options.terrain = str(kept)
    values = {"terrain": options.terrain, "rock_abundance": options.rocks or None}
    values["longest"] = options.longest
    print(machine())
    rows: dict[str, list[tuple[Flown, Flown]]] = {name: [] for name in options.priors}
    seeds = parse_seeds(options.seeds)
    if options.steep:
        seeds = [seed for seed in seeds if steep_start(seed, values)][: options.steep]
    for seed in seeds:
        without = fly(seed, values, None)
        line = [f"none {said(without, without)}"]
        for name in options.priors:
            rows[name].append((without, fly(seed, values, PRIORS[name])))
            line.append(f"{name} {said(*rows[name][-1])}")
        print(f"seed {seed}: {'; '.join(line)}", flush=True)
    print_table(rows)


def said(without: Flown, flown: Flown) -> str:
    """A flight in a few words."""
    ended = "safe" if flown.figures["safe"] else flown.figures["outcome"] + " UNSAFE"
    good = flown.targets[0] if len(flown.targets) else np.full(4, np.nan)
    return f"{good[0]:.1f} s (equal {when(without, flown):.1f}) {100.0 * good[3]:.1f} % {ended}"


def when(without: Flown, flown: Flown) -> float:
    """First target as good as that without a prior, s."""
    least = without.targets[0, 3] if len(without.targets) else 1.0
    return flown.first(least - EQUAL)


def print_table(rows: dict[str, list[tuple[Flown, Flown]]]) -> None:
    """What the flights come to, a column for each prior."""
    columns = []
    for pairs in rows.values():
        gain = np.array([when(a, a) - when(a, b) for a, b in pairs])
        named = [100.0 * np.mean([f.targets[0, 3] for f in fs if len(f.targets)])
                 for fs in zip(*pairs, strict=True)]  # fmt: skip
        worse = sum(a.figures["safe"] and not b.figures["safe"] for a, b in pairs)
        better = sum(b.figures["safe"] and not a.figures["safe"] for a, b in pairs)
        burnt = np.median([b.figures["propellant"] - a.figures["propellant"] for a, b in pairs])
        offsets = np.array([b.offset for _, b in pairs if b.offset is not None]).reshape(-1, 3, 3)
        off = offsets[:, 0] - offsets[:, 2]
        error = np.sqrt(np.mean(off**2, axis=0)) if len(off) else np.full(3, np.nan)
        columns.append(
            [
                f"{len(pairs)}",
                f"{np.median([when(a, a) for a, _ in pairs]):.1f}",
                f"{np.median([when(a, b) for a, b in pairs]):.1f}",
                f"{np.median(gain):.1f} ({np.sum(gain >= 2.0)} by 2 s and more,"
                f" {np.sum(gain < 0.0)} later)",
                f"{named[0]:.2f}, {named[1]:.2f}",
                f"{worse}, {better}",
                f"{burnt:+.2f}",
                f"{error[0]:.2f}, {error[1]:.2f}, {error[2]:.2f} ({len(off)})",
            ]
        )
    names = [
        "flights",
        "first target without, median, s",
        "first that is truly as good with it, s",
        "earlier by, median of pairs, s",
        "true probability of the very first, without and with, %",
        "unsafe with it alone, without it alone",
        "more propellant, median, kg",
        "offset at the end, error east, north, up, rms, m",
    ]
    cells = [[name, *row] for name, row in zip(names, zip(*columns, strict=True), strict=True)]
    table("A prior", ["", *rows], cells)


if __name__ == "__main__":
    main()
