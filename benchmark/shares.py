# SPDX-License-Identifier: Apache-2.0
"""Errors of leaves over their claimed standard deviations, whatever part of a leaf was observed.

The ground under one leaf of 0.25 to 8 m, which may divide down to 0.25 m, is scanned in a straight
strip of any share, direction and place, from incidences of 0 to 75 degrees, with 5 to 5,000 points
a scan, 6 cm range noise and an exact pose. It is a plane, with ``--rolling`` also waves of 12 to
60 m, or with ``--terrain`` measured ground. The ratios are those of the mean height of the observed
part, and of the slope of the whole leaf along both axes of its covariance. A calibrated map has a
root mean square of 1 and almost none beyond 4.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import machine, table
from common.as_posed import lengths
from common.claims import Claims, Surface, claims, summary
from common.rays import EXACT, looking
from matplotlib.figure import Figure
from scipy.special import erfc

from quadtree_lss.lab.simulation.terrain import Terrain, load_terrain
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import Config, config_from_values
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose

NOISE = 0.06
#: Shortest and longest waves of rolling ground, m, and how many there are.
WAVES = (12.0, 60.0, 8)
#: From a place on measured ground to its edge, at least, m: leaves have a corner there.
ROOM = 12.5
#: Sides of the coarse leaf, m; it may be divided down to 0.25 m.
SIDES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
#: Shares of the leaf that are shown apart.
SHARES = (0.01, 0.1, 0.25, 0.5, 0.75, 1.0)


@dataclass(frozen=True)
class Draw:
    """A leaf drawn at random: the share of it that was observed, in so many scans, and the claims
    of the leaf or of those it was divided into."""

    share: float
    scans: int
    found: Claims


def main() -> None:
    """Print a table, draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=4000, help="leaves of one scan")
    parser.add_argument("--of-twenty", type=int, default=1000, help="leaves of twenty scans")
    parser.add_argument("--seed", type=int, default=4510)
    text = "root mean square slope of waves, degrees"
    parser.add_argument("--rolling", type=float, default=0.0, help=text)
    parser.add_argument("--terrain", type=Path, help=".npz of measured ground")
    parser.add_argument("--figure", type=Path, help="PNG to draw")
    options = parser.parse_args()
    print(machine())
    counts = {1: options.draws, 20: options.of_twenty}
    of = math.tan(math.radians(options.rolling))
    over = of if options.terrain is None else load_terrain(options.terrain)
    found = [d for scans, n in counts.items() for d in drawn(options.seed, n, scans, over)]
    rows = []
    for scans in (1, 20):
        rows.append([f"{scans}, all", *row_of([d for d in found if d.scans == scans])])
    rows.append(["all", *row_of(found)])
    three = ["RMS", "over 4, %", "worst"]
    table(
        "error over claimed deviation: height at the middle of what was seen, slope, both",
        ["scans, and which", "draws", "measured", *3 * three],
        rows,
    )
    if options.figure:
        draw(options.figure, found)


def row_of(draws: list[Draw]) -> list[object]:
    """Leaves drawn and measured, and how their ratios are distributed."""
    out: list[object] = [len(draws), sum(len(d.found.height) for d in draws)]
    for of in ("height", "slope", "all"):
        ratios = pooled(draws, of)
        if not len(ratios):
            out += ["-"] * 3
            continue
        rms, beyond, worst = summary(ratios)
        out += [f"{rms:.2f}", f"{100 * beyond:.2f}", f"{worst:.1f}"]
    return out


def pooled(draws: list[Draw], of: str = "all") -> Array:
    """Ratios of ``height``, ``slope`` or ``all``, in one row."""
    return np.concatenate([np.zeros(0), *(getattr(d.found, of).ravel() for d in draws)])


def one_leaf(side: float) -> Config:
    """A domain that is one leaf, which may be divided down to 0.25 m."""
    domain = {"xmin": 0.0, "ymin": 0.0, "size": side, "min_level": 0}
    domain["max_level"] = round(np.log2(side / 0.25))
    values: dict[str, object] = {f"domain.{name}": value for name, value in domain.items()}
    return config_from_values(values | {"lidar.range_noise": NOISE})


def drawn(seed: int, draws: int, scans: int, over: float | Terrain = 0.0) -> list[Draw]:
    """So many leaves, each of so many scans; over waves, or a terrain, as of `ground`."""
    return [strip(np.random.default_rng([seed, scans, k]), scans, over) for k in range(draws)]


def ground(
    gradient: tuple[float, float], over: float | Terrain, rng: np.random.Generator
) -> Surface:
    """A plane, and waves of so much root mean square slope, or a terrain about some place."""
    if isinstance(over, Terrain):
        return somewhere(over, gradient, rng)
    if over == 0.0:
        return lambda x, y: gradient[0] * x + gradient[1] * y
    number = 2.0 * np.pi / np.geomspace(*WAVES)
    heading, phase = rng.uniform(0.0, 2.0 * np.pi, (2, WAVES[2]))
    high = over * np.sqrt(2.0 / WAVES[2]) / number

    def surface(x: Array, y: Array) -> Array:
        along = x[..., None] * np.cos(heading) + y[..., None] * np.sin(heading)
        waves = np.sin(number * along + phase) @ high
        return gradient[0] * x + gradient[1] * y + waves

    return surface


def somewhere(terrain: Terrain, gradient: tuple[float, float], rng: np.random.Generator) -> Surface:
    """A terrain about a place drawn at random, turned, from its height there; on a plane."""
    low_x, high_x, low_y, high_y = terrain.bounds
    place = rng.uniform([low_x + ROOM, low_y + ROOM], [high_x - ROOM, high_y - ROOM])
    turn = rng.uniform(0.0, 2.0 * np.pi)
    level = terrain.elevation_at(*place)

    def surface(x: Array, y: Array) -> Array:
        u = place[0] + np.cos(turn) * x - np.sin(turn) * y
        v = place[1] + np.sin(turn) * x + np.cos(turn) * y
        return terrain.elevation_at(u, v) - level + gradient[0] * x + gradient[1] * y

    return surface


def strip(rng: np.random.Generator, scans: int, over: float | Terrain = 0.0) -> Draw:
    """A leaf seen in a strip, each scan with points of its own."""
    side = float(rng.choice(SIDES))
    share, incidence = rng.uniform(0.01, 1.0), rng.uniform(0.0, 75.0)
    share = share if rng.random() < 0.8 else rng.uniform(0.01, 0.1)
    gradient = tuple(rng.uniform(-0.2, 0.2, 2))
    count = int(np.exp(rng.uniform(np.log(5.0), np.log(5000.0))) / (1 if scans == 1 else 4)) + 3
    turn, azimuth = rng.uniform(0.0, 2.0 * np.pi, 2)
    across = np.array([np.cos(turn), np.sin(turn)])
    # Between which lines the strip lies, so that it holds this share of the leaf.
    begin = rng.choice([0.0, rng.random(), 1.0]) * (1.0 - share)
    low, high = np.quantile(rng.uniform(0.0, side, (4000, 2)) @ across, [begin, begin + share])
    low, high = (-np.inf if begin <= 0.0 else low), (np.inf if begin + share >= 1.0 else high)
    normal = np.array([-gradient[0], -gradient[1], 1.0])
    normal /= np.linalg.norm(normal)
    # A ray that meets the ground at this incidence.
    axis = looking(np.zeros(3), -normal)
    tilted = np.tan(np.radians(incidence)) * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    back = axis @ (tilted - [0.0, 0.0, 1.0])
    middle = np.array([0.5 * side, 0.5 * side, 0.5 * side * sum(gradient)])
    position = middle + rng.uniform(100.0, 300.0) * back / np.linalg.norm(back)
    axes = looking(position, middle)
    with lengths(outlier_gate=0.0, feature_height=math.inf):
        mapper = Mapper(one_leaf(side))
    surface = ground(gradient, over, rng)
    for k in range(scans):
        # Noise carries points over the rim of the leaf, in and out.
        margin = 0.3
        number = rng.poisson(count / share * (1.0 + 2.0 * margin / side) ** 2)
        places = rng.uniform(-margin, side + margin, (min(number, 100_000), 2))
        places = places[(places @ across >= low) & (places @ across <= high)]
        to = np.column_stack([places, surface(*places.T)]) - position
        to *= 1.0 + NOISE * rng.standard_normal((len(to), 1)) / np.linalg.norm(
            to, axis=1, keepdims=True
        )
        mapper.update(to @ axes, Pose(round(1e9 + 5e7 * k), position, axes, EXACT))
    return Draw(share, scans, claims(mapper.snapshot(), surface))


def draw(file: Path, found: list[Draw]) -> None:
    """How many leaves are off by more than so many deviations, by the share of the leaf seen."""
    figure = Figure(figsize=(11.0, 4.4), layout="constrained")
    colours = ("#d55e00", "#e69f00", "#009e73", "#56b4e9", "#0072b2")
    at = np.linspace(0.0, 8.0, 401)
    for axes, of in zip(figure.subplots(1, 2), ("height", "slope"), strict=True):
        for low, high, colour in zip(SHARES, SHARES[1:], colours, strict=False):
            ratios = pooled([d for d in found if low <= d.share <= high], of)
            if not len(ratios):
                continue
            size = np.sort(np.abs(ratios))
            beyond = 1.0 - np.searchsorted(size, at, side="right") / len(size)
            rms = f"RMS {np.sqrt(np.mean(size**2)):.2f}"
            name = f"{100 * low:g} to {100 * high:g} % seen: {rms}, {len(size)} ratios"
            axes.plot(at, beyond, color=colour, lw=1.4, label=name)
        axes.plot(at, erfc(at / np.sqrt(2.0)), color="black", ls="--", lw=1.4, label="$\\chi_1$")
        axes.axvline(4.0, color="#bbbbbb", lw=0.8)
        axes.set(yscale="log", ylim=(1e-4, 1.0), xlim=(0.0, 8.0))
        axes.set(xlabel="deviations", ylabel="share of leaves that are off by more")
        axes.set_title(of, fontsize="medium")
        axes.legend(fontsize="small", loc="upper right")
    figure.savefig(file, dpi=100)


if __name__ == "__main__":
    main()
