# SPDX-License-Identifier: Apache-2.0
"""The touchdown check against a slow, straightforward one, heading by heading and cell by cell."""

import dataclasses
import itertools

import numpy as np
import pytest
from core.builders import configured, feature_height, mapped, with_lengths
from core.scenes import slope

from quadtree_lss.onboard.config.settings import Config, LssConfig
from quadtree_lss.onboard.core.landing import hazards, touchdown
from quadtree_lss.onboard.core.landing.raster import TerrainRaster, rasterise
from quadtree_lss.onboard.core.landing.sites import LandingSiteSelector
from quadtree_lss.onboard.core.landing.touchdown import Limits, TouchdownCheck
from quadtree_lss.onboard.core.tree.cell_map import CellMap

SMALL = {"size": 8.0, "min_level": 1, "max_level": 4}
#: A feature's bell peaks a quarter above the boulder whose height is published (Eq. 49).
BELL = 1.25


class SlowLander:
    """Stands on the leaf planes of a fully measured map, one grid point and heading at a time."""

    def __init__(self, cells: CellMap, config: LssConfig) -> None:
        self.cells, self.config = cells, config
        self.n, self.side = cells.domain.finest_count, cells.domain.finest_size
        leaf = cells.leaf_raster()
        self.leaf = np.array(leaf)
        self.slope_x = -cells.normal[:, 0] / cells.normal[:, 2]
        self.slope_y = -cells.normal[:, 1] / cells.normal[:, 2]

    def ground(self, k: int, x: float, y: float) -> float:
        c = self.cells
        return c.z[k] + self.slope_x[k] * (x - c.x[k]) + self.slope_y[k] * (y - c.y[k])

    def pad(self, row: int, column: int, x: float, y: float) -> float:
        """Height that a pad at offset x, y from a grid point stands on: the highest under it."""
        d = self.cells.domain
        k = self.leaf[row + int(np.floor(y / self.side)), column + int(np.floor(x / self.side))]
        tilt = np.hypot(self.slope_x[k], self.slope_y[k])
        at_x, at_y = d.xmin + column * self.side + x, d.ymin + row * self.side + y
        return self.ground(k, at_x, at_y) + self.config.vehicle.pad_radius * tilt

    def tops(self, row: int, column: int) -> list[tuple[float, float, float]]:
        """Offset and highest ground of each finest cell whose centre is in the lander's circle."""
        d, out = self.cells.domain, []
        for r, c in itertools.product(range(self.n), repeat=2):
            x, y = (c + 0.5 - column) * self.side, (r + 0.5 - row) * self.side
            if np.hypot(x, y) > 0.5 * self.config.vehicle.diameter:
                continue
            k = self.leaf[r, c]
            cx, cy = d.xmin + (c + 0.5) * self.side, d.ymin + (r + 0.5) * self.side
            z = self.ground(k, cx, cy)
            z += 0.5 * self.side * (abs(self.slope_x[k]) + abs(self.slope_y[k]))
            if np.isfinite(self.cells.feature[k, 1]):
                x0, y0 = cx - self.cells.x[k], cy - self.cells.y[k]
                over = (np.arange(64) + 0.5) / 64.0 * self.side - 0.5 * self.side
                bell = feature_height(self.cells.feature[k], x0 + over, (y0 + over)[:, None])
                z += BELL * float(bell.mean())
            out.append((x, y, z))
        return out

    def worst(self, row: int, column: int) -> tuple[float, float]:
        """Greatest tangent of slope and greatest height over a resting plane, over all headings."""
        config = self.config
        radius, tops = 0.5 * config.vehicle.diameter, np.array(self.tops(row, column))
        steepest, highest = 0.0, -np.inf
        for k in range(touchdown.YAWS):
            yaw = k * 0.5 * np.pi / touchdown.YAWS
            c, s = np.cos(yaw), np.sin(yaw)
            feet = [(c, s), (-s, c), (-c, -s), (s, -c)]
            feet = [(radius * x, radius * y) for x, y in feet]
            pads = [(x, y, self.pad(row, column, x, y)) for x, y in feet]
            carried = 0 if pads[0][2] + pads[2][2] >= pads[1][2] + pads[3][2] else 1
            for third in (carried + 1, (carried + 3) % 4):
                three = np.array([pads[carried], pads[carried + 2], pads[third]])
                plane = np.linalg.solve(np.column_stack([three[:, :2], np.ones(3)]), three[:, 2])
                steepest = max(steepest, float(np.hypot(plane[0], plane[1])))
                over = tops[:, 2] - tops[:, :2] @ plane[:2] - plane[2]
                highest = max(highest, float(over.max()))
        return steepest, highest


def unsafe(config, raster: TerrainRaster, candidates: np.ndarray) -> np.ndarray:
    """Grid points at which some heading is over the touchdown limits."""
    check = TouchdownCheck(config.lss)
    return candidates & check.over(check.worst(raster, candidates))


def touchdown_bits(cells: CellMap, config) -> np.ndarray:
    lss = dataclasses.replace(config.lss, grid_spacing=cells.domain.finest_size)
    fine = dataclasses.replace(config, lss=lss)
    return LandingSiteSelector(fine).assess(cells).hazard & hazards.TOUCHDOWN > 0


def landable(cells: CellMap, config) -> list[tuple[int, int]]:
    """Grid points whose lander circle lies inside the domain."""
    n, side = cells.domain.finest_count, cells.domain.finest_size
    reach = 0.5 * config.vehicle.diameter
    inside = [k for k in range(n + 1) if min(k, n - k) * side >= reach]
    return list(itertools.product(inside, inside))


def assert_agrees(cells: CellMap, config) -> None:
    """Point by point with the slow check, of which some must pass and some fail."""
    assert cells.measured.all()
    found, slow = touchdown_bits(cells, config), SlowLander(cells, config.lss)
    limit = np.tan(np.radians(config.vehicle.lengths.touchdown_slope_deg))
    outcome, rough = set(), config.vehicle.lengths.touchdown_roughness
    for row, column in landable(cells, config):
        steepest, highest = slow.worst(row, column)
        if min(abs(steepest - limit), abs(highest - rough)) < 1e-5:
            continue  # too near to call in single precision
        fails = steepest > limit or highest > rough
        assert found[row, column] == fails, (row, column, steepest, highest)
        outcome.add(fails)
    assert outcome == {True, False}


def uneven(rng: np.random.Generator, size: float, mounds: int):
    """Gently tilted ground with mounds of 5 to 40 cm."""
    place, high = rng.uniform(0.0, size, (mounds, 2)), rng.uniform(0.05, 0.4, mounds)

    def ground(x, y):
        parts = [
            h * np.exp(-((x - a) ** 2 + (y - b) ** 2) / (0.1 + h))
            for (a, b), h in zip(place, high, strict=True)
        ]
        return 0.03 * x + np.sum(parts, axis=0)

    return ground


@pytest.fixture
def landing_at(monkeypatch):
    """Configurations of a lander of 2.9 m that is set down at so many headings."""

    def configuration(domain: dict[str, object], yaws: int, diameter: float = 2.9) -> Config:
        monkeypatch.setattr(touchdown, "YAWS", yaws)
        lander, lss = {"diameter": diameter, "hazard_growth": 0.0}, {"max_gap": 0.6}
        return configured(domain=domain, noise=0.02, vehicle=lander, lss=lss)

    return configuration


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("yaws", [1, 5])
def test_rough_ground_against_the_slow_check(landing_at, seed, yaws):
    config = landing_at(SMALL, yaws)
    ground = uneven(np.random.default_rng(seed), 8.0, 12)
    assert_agrees(mapped(config, ground, density=150.0, scans=1, seed=seed).snapshot(), config)


def test_subscale_features_stand_out_of_the_ground(landing_at):
    """Rocks a little lower than the limit on smooth ground, their bells some over it."""
    config = landing_at(SMALL, 3)
    cells = mapped(config, slope(0.02, -0.03), density=100.0, scans=1).snapshot()
    feature = np.full((len(cells.z), 5), np.nan)
    sigma = 0.3
    for k, high in enumerate(np.linspace(0.16, 0.28, len(cells.z))):
        volume_root = np.sqrt(2.0 * np.pi * high) * sigma
        feature[k] = (0.0, volume_root, 0.25, -0.25, sigma)  # on a finest cell's centre
    assert_agrees(dataclasses.replace(cells, feature=feature), config)


@pytest.mark.parametrize(
    ("growth", "reach"), [(0.0, 0.0), (0.25, 0.5), (0.5, 0.5), (0.8, 1.0), (1.3, 1.5)]
)
def test_unsafe_ground_grows_by_the_set_length_rounded_outwards(growth, reach):
    """Points lie half a metre apart: the next one at the least is unsafe, if it grows at all."""
    lander = {"diameter": 2.9, "hazard_growth": 0.0}
    config = configured(domain=SMALL, noise=0.02, vehicle=lander)

    def ground(x, y):
        return 0.5 * ((np.abs(x - 3.3) < 0.5) & (np.abs(y - 4.8) < 0.5))

    cells = mapped(config, ground, density=150.0, scans=1).snapshot()
    bare = touchdown_bits(cells, config)
    grown = touchdown_bits(cells, with_lengths(config, hazard_growth=growth))
    unsafe = np.argwhere(bare)
    for row, column in landable(cells, config):
        distance = cells.domain.finest_size * np.hypot(*(unsafe - (row, column)).T).min()
        assert grown[row, column] == (distance <= reach)


def placed(raster: TerrainRaster, rows: int, columns: int) -> TerrainRaster:
    """The ground so many cells farther north-east on a domain twice as large, edges repeated."""
    n = raster.domain.finest_count
    around = ((rows, n - rows), (columns, n - columns))
    arrays = {name: value for name, value in vars(raster).items() if np.ndim(value) == 2}
    layers = {name: np.pad(value, around, mode="edge") for name, value in arrays.items()}
    domain = raster.domain
    larger = dataclasses.replace(domain, size=2 * domain.size, max_level=domain.max_level + 1)
    return dataclasses.replace(raster, domain=larger, **layers)


@pytest.mark.parametrize("yaws", [1, 4, 7])
@pytest.mark.parametrize("diameter", [0.4, 2.0, 3.7])
@pytest.mark.parametrize("shift", [(0, 3), (5, 1), (2, 6)])
def test_how_grid_points_fall_into_blocks_changes_nothing(landing_at, yaws, diameter, shift):
    """Other blocks are other planes to compare with and other bounds."""
    config = landing_at({"size": 16.0, "min_level": 1, "max_level": 6}, yaws, diameter)
    ground = uneven(np.random.default_rng(9), 16.0, 40)
    raster = rasterise(mapped(config, ground, density=150.0, scans=1).snapshot(), LssConfig())
    candidates = np.zeros((65, 65), dtype=np.bool_)
    candidates[8:-8, 8:-8] = True  # 2 m from the edge
    moved = np.zeros((129, 129), dtype=np.bool_)
    there = np.s_[shift[0] : shift[0] + 65, shift[1] : shift[1] + 65]
    moved[there] = candidates
    found, again = unsafe(config, raster, candidates), unsafe(config, placed(raster, *shift), moved)
    np.testing.assert_array_equal(again[there], found)
    assert found.any()
    assert not found[candidates].all()


def test_far_from_sea_level_the_verdict_is_the_same(landing_at):
    config = landing_at({"size": 16.0, "min_level": 1, "max_level": 6}, 5)
    ground = uneven(np.random.default_rng(9), 16.0, 40)
    raster = rasterise(mapped(config, ground, density=150.0, scans=1).snapshot(), LssConfig())
    high = dataclasses.replace(raster, elevation=raster.elevation + 3000.0)
    everywhere = np.ones((65, 65), dtype=np.bool_)
    low, found = (unsafe(config, ground, everywhere) for ground in (raster, high))
    np.testing.assert_array_equal(found, low)


@pytest.mark.parametrize("layer", ["elevation", "slope_x", "slope_y", "subscale"])
def test_a_cell_that_changes_is_judged_again(landing_at, layer):
    """Whatever changes in it, and wherever in a block: who follows the map says what a new checker
    does, to the bit."""
    config = landing_at({"size": 16.0, "min_level": 1, "max_level": 6}, 3)
    ground = uneven(np.random.default_rng(9), 16.0, 40)
    raster = rasterise(mapped(config, ground, density=60.0, scans=1).snapshot(), LssConfig())
    candidates = np.zeros((65, 65), dtype=np.bool_)
    candidates[6:-6, 6:-6] = True
    wide = Limits((0.0, 9.0), (0.0, 9.0))
    follower = TouchdownCheck(config.lss, wide)
    before = follower.worst(raster, candidates).rise.copy()
    for k in range(18):
        row, column = 22 + k, 40 - k  # each row and each column of the blocks
        values = getattr(raster, layer).copy()
        values[row, column] += 4.0 if layer.startswith("slope") else 0.4
        raster = dataclasses.replace(raster, **{layer: values})
        if k == 9:
            candidates = np.ones_like(candidates)  # others become due
        found = follower.worst(raster, candidates)
        anew = TouchdownCheck(config.lss, wide).worst(raster, candidates)
        np.testing.assert_array_equal(found.rise[candidates], anew.rise[candidates])
        np.testing.assert_array_equal(found.slope[candidates], anew.slope[candidates])
        near = np.s_[row - 5 : row + 7, column - 5 : column + 7]
        assert (found.rise[near] != before[near]).any()
        before = found.rise.copy()
