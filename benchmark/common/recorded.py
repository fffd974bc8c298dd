# SPDX-License-Identifier: Apache-2.0
"""Section VI over the paper's ground and over real terrain, and recorded lidar: heights judged.

Files that others measured lie in ``shared/data`` beside the checkout; what is not there is left
out.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from common.claims import within
from common.flights import configuration
from common.tables import table
from quadtree_lss.desk.replay.replay import scans
from quadtree_lss.lab.simulation.simulate import simulate
from quadtree_lss.lab.simulation.terrain import Terrain, load_terrain
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.raster import rasterise
from quadtree_lss.onboard.core.landing.sites import LandingSiteSelector
from quadtree_lss.onboard.core.mapping.mapper import Mapper

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def section_vi(seeds: list[int] | None, quick: bool) -> None:
    """The paper's flight over its parabola, and over real terrain: quadtree and fixed cells."""
    configs = [configuration("parabola"), configuration("parabola", "parabola_fixed")]
    rows = []
    for name, terrain in terrains():
        for seed in seeds or ([201] if quick else range(441, 447)):
            with tempfile.TemporaryDirectory() as folder:
                bag, duration = Path(folder) / "bag", 12.0 if quick else None
                simulate("parabola", bag, seed=seed, duration=duration, terrain=terrain)
                with np.load(bag.parent / "truth.npz") as truth:
                    x, y, z = (truth[of].astype(float) for of in ("x", "y", "elevation"))
                flight = list(scans(bag, configs[0]))
            ground = RegularGridInterpolator((y, x), z, bounds_error=False)
            tree, fixed = (flown(config, flight, ground) for config in configs)
            own = [summed(tree[0]), summed(fixed[0])]
            common = np.isfinite(tree[0]) & np.isfinite(fixed[0])
            shared = [summed(of[0][common]) for of in (tree, fixed)]
            pairs = [f"{v:.3f}" for pair in zip(*own, strict=True) for v in pair]
            ratio = [f"{a / b:.2f}" for two in (own, shared) for a, b in zip(*two, strict=True)]
            rows.append([name, seed, *pairs, *ratio, *tree[1:], *fixed[1:]])
    table(
        "section_vi: quadtree, fixed cells, and their ratio, over cells that each knows and over"
        " those that both know; height at points",
        ["ground", "seed", "mean", "fixed", "RMS", "fixed", "greatest", "fixed"]
        + ["mean", "RMS", "greatest", "both: mean", "RMS", "greatest"]
        + ["leaves", "ms, all scans", "fixed", "ms"],
        rows,
    )


def terrains() -> list[tuple[str, Path | Terrain | None]]:
    """The paper's parabola, and those of others that are at hand, made as large as a flight."""
    found: list[tuple[str, Path | Terrain | None]] = [("parabola", None)]
    if (DATA / "apollo15.npz").exists():
        found.append(("apollo15", DATA / "apollo15.npz"))
    if (DATA / "marsyard2021.npz").exists():
        # 36 m of it: four times as wide and high.
        yard = load_terrain(DATA / "marsyard2021.npz")
        found.append(("marsyard2021, 4 x", yard.scaled(4.0)))
    return found


def summed(error: np.ndarray) -> tuple[float, float, float]:
    """Mean, RMS and greatest of absolute errors, NaN left out."""
    return float(np.nanmean(error)), float(np.sqrt(np.nanmean(error**2))), float(np.nanmax(error))


def flown(config: Config, flight: list, ground: RegularGridInterpolator) -> list:
    """Errors (n, n, 16) in known finest cells, else NaN; leaves, CPU time of all scans, ms."""
    mapper, spent = Mapper(config), 0.0
    for scan in flight:
        began = time.process_time()
        mapper.update(scan.points_lidar, scan.pose, scan.sweep)
        spent += time.process_time() - began
    cells = mapper.snapshot()
    row, column = np.nonzero(cells.known)
    side = cells.domain.finest_size
    part = (np.stack(np.meshgrid(*[np.arange(4)] * 2), axis=-1).reshape(-1, 2) + 0.5) / 4.0
    x = cells.domain.xmin + side * (column[:, None] + part[:, 0])
    y = cells.domain.ymin + side * (row[:, None] + part[:, 1])
    error = np.full((*cells.known.shape, 16), np.nan)
    error[row, column] = np.abs(cells.at(x, y).height - ground(np.stack([y, x], axis=-1)))
    return [error, int(cells.estimated.sum()), f"{1e3 * spent:.1f}"]


def autzen(seeds: list[int] | None, quick: bool) -> None:
    """Recorded lidar: heights that are given out, against the returns within a metre."""
    bag = DATA / "autzen_meadow"
    if not bag.exists():
        print("\nautzen: the recording is not at hand")
        return
    rows = []
    for names in (("default",), ("morpheus",), ("flight",)):
        config = configuration(*names)
        mapper, points = Mapper(config), []
        for scan in scans(bag, config, duration=5.0 if quick else None):
            mapper.update(scan.points_lidar, scan.pose, scan.sweep)
            flat = scan.points_lidar.reshape(-1, 3)
            flat = flat[np.isfinite(flat).all(axis=1)]
            points.append(flat @ scan.pose.rotation_map_lidar.T + scan.pose.position)
        cells, returns = mapper.snapshot(), np.concatenate(points)
        found = LandingSiteSelector(config).assess(cells)
        side = cells.domain.finest_size
        row, column = np.nonzero(cells.observed)
        x, y = cells.domain.xmin + side * (column + 0.5), cells.domain.ymin + side * (row + 0.5)
        at = [("leaf planes", x, y, cells.at(x, y).height)]
        raster = rasterise(cells, config.lss).elevation[row, column]
        at.append(("raster", x, y, raster))
        row, column = np.nonzero(np.isfinite(found.elevation))
        at.append(("grid elevation", found.x[column], found.y[row], found.elevation[row, column]))
        for what, x, y, z in at:
            low, high = within(returns, x, y)
            excess = np.fmax(z - high, low - z)
            excess = excess[np.isfinite(excess)]
            rows.append(
                [f"{names[0]}, {what}", len(excess), f"{returns[:, 2].min():.1f}"]
                + [f"{returns[:, 2].max():.1f}", f"{np.nanmin(z):.1f}", f"{np.nanmax(z):.1f}"]
                + [f"{excess.max():.2f}", int((excess > 0.3).sum())]
            )
    table(
        "autzen: heights at seen places, beyond the returns within 1 m",
        ["", "places", "returns from", "to", "heights from", "to", "greatest excess m"]
        + ["beyond 0.3 m"],
        rows,
    )
