# SPDX-License-Identifier: Apache-2.0
"""Reliability of the predicted risk, on families of flights that its fit did not use."""

from __future__ import annotations

import argparse
import hashlib
import pickle
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import configuration, data_folder, machine, table
from matplotlib import colormaps
from matplotlib.figure import Figure
from scipy.interpolate import RectBivariateSpline

from quadtree_lss.desk.replay.files import write_bytes
from quadtree_lss.lab.campaign.study import parse_seeds, this_build
from quadtree_lss.lab.evaluation.metrics import scores
from quadtree_lss.lab.evaluation.risk_families import FAMILIES
from quadtree_lss.lab.evaluation.risk_fit import risks, unfitted
from quadtree_lss.lab.evaluation.risk_flights import Mapped, fly, land
from quadtree_lss.lab.simulation.hazard_field import add_rocks_to
from quadtree_lss.lab.simulation.terrain import Terrain, load_terrain
from quadtree_lss.onboard.arrays import Array, Index, Mask, Single
from quadtree_lss.onboard.config.risk import risk_model
from quadtree_lss.onboard.config.settings import Config, LssConfig

BINS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3)
LIMITS = (0.001, 0.0018, 0.002, 0.003, 0.005, 0.008, 0.012, 0.02, 0.05)
RESAMPLES = 500
TILE = 2.2
"""Side of the tiles, diameters, whose failures are treated as independent."""
HALF, POST = 40.0, 0.1
#: Families of the flights over measured terrains, in turn, three times.
TERRAIN_FAMILIES = ("whole", "thin", "few", "views")
#: By family and range of the risk; by ``lss.max_risk``.
TABLES = ("reliability", "limits")
KEEP = Path("build", "evidence", "risk")


@dataclass(frozen=True)
class EvaluatedMap:
    """All landings on a map: features (K, F), failures (K,), tiles (K,), which the maps of one
    flight share, and the fraction of the flight."""

    features: Single
    failed: Mask
    tile: Index
    part: float


def main() -> None:
    """Print the tables and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--seeds", default="119208-119415", help="of flights, assigned to the families in turn")
    text = ".npz of terrains, flown with and without rocks; also in QUADTREE_LSS_DATA"
    add("--terrain", type=Path, nargs="+", default=[], help=text)
    add("--model", default="", help="file of fit-risk, by default the one of the package")
    add("--keep", type=Path, default=KEEP, help="folder of simulated flights")
    add("--tables", nargs="+", choices=TABLES, default=TABLES, help="tables to print")
    add("--jobs", type=int, help="flights at once, by default one for each core")
    add("--figure", type=Path, help="PNG to draw")
    options = parser.parse_args()
    print(machine())
    config, model = configuration("morpheus"), risk_model(options.model)
    by = hashlib.sha256(repr((this_build(), config)).encode()).hexdigest()[:8]
    keep = options.keep / by  # separate for each build
    keep.mkdir(parents=True, exist_ok=True)
    terrains = [path if path.is_file() else data_folder() / path for path in options.terrain]
    evaluated = fly_all(parse_seeds(options.seeds), config, keep, terrains, options.jobs)
    predicted = {
        name: [risks(model, of.features) for of in maps] for name, maps in evaluated.items()
    }
    if "reliability" in options.tables:
        reliability(evaluated, predicted)
    if "limits" in options.tables:
        curve(evaluated["whole"], predicted["whole"])
    if options.figure:
        draw(options.figure, evaluated, predicted)


def fly_all(
    seeds: list[int], config: Config, keep: Path, terrains: list[Path], jobs: int | None
) -> dict[str, list[EvaluatedMap]]:
    """Flights by family, and over measured terrains with and without rocks, which no fit uses."""
    names = list(FAMILIES)
    flights: list[tuple[str, str, int, Path | None, float]] = [
        (names[number % len(names)], names[number % len(names)], seed, None, 0.0)
        for number, seed in enumerate(seeds)
    ]
    for path in terrains:
        for title, rocks in ((path.stem, 0.0), (f"{path.stem} + rocks", 0.05)):
            flights += [
                (title, TERRAIN_FAMILIES[k % len(TERRAIN_FAMILIES)], seed, path, rocks)
                for k, seed in enumerate(seeds[: 3 * len(TERRAIN_FAMILIES)])
            ]
    out: dict[str, list[EvaluatedMap]] = {title: [] for title in [*names, *(f[0] for f in flights)]}
    with ProcessPoolExecutor(jobs) as pool:
        flown = [pool.submit(evaluated_flight, keep, config, *flight) for flight in flights]
        for (title, *_), future in zip(flights, flown, strict=True):
            out[title] += future.result()
    return out


def evaluated_flight(
    keep: Path, config: Config, title: str, family: str, seed: int, path: Path | None, rocks: float
) -> list[EvaluatedMap]:
    """Return the maps of a flight from a file in ``keep``, which is written if it does not exist.

    ``path`` is a measured terrain, of which ``rocks`` is the share under added rocks.
    """
    file = keep / f"{title.replace(' ', '')}_{seed}.pkl"
    if not file.exists():
        ground = None
        if path is not None:
            rng = np.random.default_rng([seed, 2])
            ground = terrain_sample(rng, load_terrain(path))
            ground = add_rocks_to(rng, ground, rocks) if rocks else ground
        maps = [
            evaluate_map(mapped, seed) for mapped in fly(FAMILIES[family], seed, config, ground)
        ]
        write_bytes(file, pickle.dumps(maps))
    return list(pickle.loads(file.read_bytes()))


def evaluate_map(mapped: Mapped, seed: int) -> EvaluatedMap:
    """Compute all landings of a map."""
    landings = land(mapped, unfitted())
    finest = mapped.cells.domain.finest_size
    side = max(1, round(TILE * mapped.config.vehicle.diameter / finest))
    row, column = np.argwhere(landings.usable).T // side
    tiles = 10**8 * seed + 10_000 * row + column
    return EvaluatedMap(landings.features, landings.failed, tiles, mapped.part)


def terrain_sample(rng: np.random.Generator, terrain: Terrain) -> Terrain:
    """Cut 80 x 80 m, or less, at random from a terrain and rotate it; posts 0.1 m apart."""
    xmin, xmax, ymin, ymax = terrain.bounds
    half = POST * np.floor(min(HALF, 0.5 * (xmax - xmin), 0.5 * (ymax - ymin)) / POST - 1e-6)
    free = np.array([0.5 * (xmax - xmin) - half, 0.5 * (ymax - ymin) - half])
    cx, cy = np.array([xmin + xmax, ymin + ymax]) / 2.0 + rng.uniform(-1.0, 1.0, 2) * free
    own = np.linspace(-half, half, round(2.0 * half / POST) + 1)
    near = [np.abs(axis - c) <= half + 5.0 for axis, c in ((terrain.y, cy), (terrain.x, cx))]
    ground = RectBivariateSpline(
        terrain.y[near[0]], terrain.x[near[1]], terrain.elevation[np.ix_(*near)]
    )
    z = np.rot90(ground(own + cy, own + cx), rng.integers(4))
    return Terrain(own, own, np.ascontiguousarray(z - z.mean()))


def reliability(
    evaluated: dict[str, list[EvaluatedMap]], predicted: dict[str, list[Array]]
) -> None:
    """Print a row for each family; another for ``whole`` after a third of the flight."""
    rows = []
    for name, maps in evaluated.items():
        picks = {name: [True] * len(maps)}
        if name == "whole":
            picks |= {"whole, at most a third flown": [one.part < 0.34 for one in maps]}
        for of, pick in picks.items():
            some = [
                (one, p) for one, p, yes in zip(maps, predicted[name], pick, strict=True) if yes
            ]
            if some:
                rows.append([of, *reliability_row(some)])
    bins = [f"{100 * a:g}-{100 * b:g}" for a, b in zip(BINS, BINS[1:], strict=False)]
    header = ["family", *bins, "called safe", "unsafe of it, %", "safe kept, %", "Brier", "log"]
    table("True unsafe share over the predicted risk, by predicted risk in %", header, rows)


def reliability_row(some: list[tuple[EvaluatedMap, Array]]) -> list[str]:
    """Ratios with 90 % intervals by resampling of tiles, and figures of the default limit."""
    risk, failed = np.concatenate([p for _, p in some]), np.concatenate([j.failed for j, _ in some])
    if not failed.size:
        return ["-"] * (len(BINS) + 4)
    tiles, place = np.unique(np.concatenate([one.tile for one, _ in some]), return_inverse=True)
    rng = np.random.default_rng(1)
    times = rng.multinomial(len(tiles), np.full(len(tiles), 1.0 / len(tiles)), RESAMPLES)
    out = []
    for low, high in zip(BINS, BINS[1:], strict=False):
        here = (risk >= low) & (risk < high)
        if here.sum() < 300:
            out.append("-")
            continue
        sums = [np.bincount(place[here], v[here], len(tiles)) for v in (failed, risk)]
        with np.errstate(invalid="ignore", divide="ignore"):
            lower, upper = np.nanpercentile((times @ sums[0]) / (times @ sums[1]), (5.0, 95.0))
        out.append(f"{sums[0].sum() / sums[1].sum():.2f} ({lower:.1f}-{upper:.1f})")
    safe = risk <= LssConfig().max_risk
    unsafe = 100.0 * failed[safe].mean() if safe.any() else 0.0
    kept = 100.0 * safe[~failed].mean() if not failed.all() else np.nan
    return [*out, f"{safe.sum():,}", f"{unsafe:.3f}", f"{kept:.1f}"] + [
        f"{value:.4f}" for value in scores(risk, failed)
    ]


def detection_rates(evaluated: list[EvaluatedMap], predicted: list[Array]) -> Array:
    """Detected hazards and kept safe ground for each of `LIMITS`, at the ends of flights: (L, N,
    2)."""
    ends = [(one, p) for one, p in zip(evaluated, predicted, strict=True) if one.part == 1.0]
    ends = [(one, p) for one, p in ends if one.failed.sum() >= 20]
    return np.array(
        [
            [[(p > limit)[one.failed].mean(), (p <= limit)[~one.failed].mean()] for one, p in ends]
            for limit in LIMITS
        ]
    )


def curve(evaluated: list[EvaluatedMap], predicted: list[Array]) -> None:
    """Print the operating points."""
    rows = []
    for limit, of in zip(LIMITS, 100.0 * detection_rates(evaluated, predicted), strict=True):
        found, kept = of.T
        rows.append(
            [f"{limit:g}", f"{found.mean():.2f}", f"{found.min():.2f}", f"{kept.mean():.1f}"]
        )
    header = ["`lss.max_risk`", "unsafe ground found, mean %", "worst flight, %"]
    header += ["safe ground kept, mean %"]
    table("Ends of the `whole` flights", header, rows)


def draw(
    file: Path, evaluated: dict[str, list[EvaluatedMap]], predicted: dict[str, list[Array]]
) -> None:
    """Draw the reliability of all families and the operating points of whole flights."""
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.set_prop_cycle(color=colormaps["tab20"].colors)
    edges = np.geomspace(3e-4, 0.9, 12)
    for name, maps in evaluated.items():
        if not maps:
            continue
        risk, failed = np.concatenate(predicted[name]), np.concatenate([one.failed for one in maps])
        at = [(risk >= a) & (risk < b) for a, b in zip(edges, edges[1:], strict=False)]
        at = [here for here in at if here.sum() >= 300]
        x, y = [risk[here].mean() for here in at], [failed[here].mean() for here in at]
        left.plot(x, y, "-" if name in FAMILIES else "--", marker=".", label=name, linewidth=1.0)
    left.plot(edges, edges, "k", linewidth=0.8)
    left.fill_between(edges, edges / 2.0, edges * 2.0, color="0.9", label="within a factor of 2")
    left.set(xscale="log", yscale="log", xlabel="predicted risk", ylabel="truly unsafe share")
    left.set(ylim=(1e-4, 1.0))
    left.legend(fontsize=7)
    of = detection_rates(evaluated["whole"], predicted["whole"])
    for what, values in (("mean", of.mean(axis=1)), ("worst flight", of.min(axis=1))):
        kept, missed = 100.0 * of[:, :, 1].mean(axis=1), 100.0 * (1.0 - values[:, 0])
        right.plot(kept, np.maximum(missed, 1e-3), marker=".", label=what)
    for limit, x in zip(LIMITS, 100.0 * of[:, :, 1].mean(axis=1), strict=True):
        right.annotate(f"{limit:g}", (x, 1.3e-3), fontsize=7, rotation=90, ha="center")
    right.set(yscale="log", xlabel="safe ground kept, %", ylabel="hazards missed, %")
    right.set(title="whole flights, by lss.max_risk")
    right.legend()
    figure.savefig(file, dpi=100)


if __name__ == "__main__":
    main()
