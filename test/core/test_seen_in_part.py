# SPDX-License-Identifier: Apache-2.0
"""Nothing that was measured is lost, and no height is beyond what was measured.

Scenes of closed formulas (``benchmark/common/rays.py``) are seen in every way that leaves leaves
seen in part: small footprints, strips, edges, few looks, in any order, with any coarsest leaf.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmark"))

from common.rays import Scene, View, fan, rocks, view
from scipy.ndimage import maximum_filter, minimum_filter

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.lab.simulation.safety import LandingGear, worst_contact
from quadtree_lss.lab.simulation.terrain import Terrain
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.landing.raster import rasterise
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.tree.cell_map import CellMap

NOISE, HALF = 0.06, 8.0
#: Ground is seen within this of the origin, m.
AREA = 5.0
#: The ground east of this is not scanned where there is an edge.
EDGE = 1.0
NARROW = fan(1.0, 64)
KINDS = ("footprints", "strips", "edge", "few looks")
#: m, by which the lander must truly be beyond its clearance; deg, beyond its slope.
SPARE, SPARE_DEG = 0.02, 0.5


def configured(rng: np.random.Generator) -> Config:
    """The flight's map on 16 m, with coarsest leaves of 1 to 8 m, anywhere under the ground."""
    shift = rng.uniform(-1.0, 1.0, 2) - HALF
    domain = {"xmin": shift[0], "ymin": shift[1], "size": 2.0 * HALF}
    domain |= {"min_level": int(rng.integers(1, 5)), "max_level": 6}
    return load_config(["flight"], {f"domain.{name}": value for name, value in domain.items()})


def views(rng: np.random.Generator, scene: Scene, kind: str) -> list[View]:
    """The scene as it is seen, in any order."""
    found: list[View] = []
    turn, times = 2.0 * np.pi * rng.random(), 1.0 + 0.05 * rng.permutation(3000)

    def look(aim: np.ndarray, far: float, up: float, rays: np.ndarray, keep=None) -> None:
        heading, target = turn + rng.normal(0.0, 0.3), np.array([*aim, float(scene.plane(*aim))])
        level = np.cos(up) * np.array([np.cos(heading), np.sin(heading)])
        position, stamp = target + far * np.array([*level, np.sin(up)]), times[len(found)]
        found.append(view(scene, position, target, rays, NOISE, rng, stamp, keep=keep))

    if kind == "footprints":
        width = rng.uniform(0.8, 1.6)
        steps = np.arange(-AREA, AREA + width, 0.8 * width)
        rays = fan(np.degrees(2.0 * np.arctan(0.5 * width / 60.0)), 48)
        for aim in np.repeat(np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2), 2, axis=0):
            look(aim, 60.0, np.pi / 2.0, rays)
        return sorted(found, key=lambda one: one.pose.stamp_ns)
    for _ in range(rng.integers(10, 50)):
        up, aim = np.radians(rng.uniform(25.0, 70.0)), rng.uniform(-AREA, AREA, 2)
        side, half = 2.0 * np.pi * rng.random(), rng.uniform(0.25, 1.5)

        def in_strip(x: np.ndarray, y: np.ndarray, aim=aim, side=side, half=half):
            return np.abs(np.cos(side) * (x - aim[0]) + np.sin(side) * (y - aim[1])) < half

        keeps = {"strips": in_strip, "edge": lambda x, _: x < EDGE}
        look(aim, rng.uniform(80.0, 300.0), up, NARROW, keeps.get(kind))
    return sorted(found, key=lambda one: one.pose.stamp_ns)


def points_of(seen: list[View]) -> np.ndarray:
    """(N, 3) returns in the map."""
    return np.concatenate(
        [v.points.reshape(-1, 3) @ v.pose.rotation_map_lidar.T + v.pose.position for v in seen]
    )


def mapped(config: Config, seen: list[View]) -> CellMap:
    """All views in order."""
    mapper = Mapper(config)
    for one in seen:
        mapper.update(one.points, one.pose)
    return mapper.snapshot()


def strewn(rng: np.random.Generator, kind: str) -> tuple[Scene, np.ndarray]:
    """Rocks of 0.25 to 0.5 m on level or inclined ground, and their heights."""
    plane = Scene(gradient=tuple(rng.uniform(-0.07, 0.07, 2)))
    places, high = rng.uniform(-AREA, AREA, (5, 2)), rng.uniform(0.25, 0.5, 5)
    if kind == "edge":
        # Where the scanned ground ends.
        places[:, 0] = EDGE - rng.uniform(0.1, 0.6, 5)
    spheres = rocks(places[:3], high[:3], high[:3] * rng.uniform(0.8, 1.3, 3), plane)
    ground = plane.plane(*places.T)
    cone = [*places[3], ground[3], rng.uniform(0.3, 0.6), high[3]]
    half = rng.uniform(0.15, 0.4, 2)
    low, top = ground[4] - 0.2, ground[4] + high[4]
    box = [*(places[4] - half), low, *(places[4] + half), top]
    return Scene(plane.gradient, spheres, np.array([cone]), np.array([box])), high


def well_seen(scene: Scene, high: np.ndarray, seen: list[View]) -> Scene:
    """With those rocks alone that 50 returns fell on, and five on the uppermost fifth."""
    hit = np.concatenate([one.hit.ravel() for one in seen])
    x, y, z = points_of(seen).T
    over = z - scene.plane(x, y) > 0.8 * np.append(high, np.inf)[hit]
    number = np.bincount(hit[hit >= 0], minlength=len(high))
    upper = np.bincount(hit[(hit >= 0) & over], minlength=len(high))
    keep = np.split((number >= 50) & (upper >= 5), [3, 4])
    return Scene(scene.gradient, scene.spheres[keep[0]], scene.cones[keep[1]], scene.boxes[keep[2]])


def stood_on(config: Config, seen: list[View], scene: Scene) -> tuple[int, str]:
    """How many places the map allows, and how many of them are truly beyond the lander's limits."""
    found = LandingSiteSelector(config).assess(mapped(config, seen))
    row, column = np.nonzero(found.safe)
    places = np.column_stack([found.x[column], found.y[row]])
    axis = np.arange(-HALF - 4.0, HALF + 4.0, 0.05)
    slope, rise = worst_contact(Terrain(axis, axis, scene.dem(axis, axis)), places, LandingGear())
    bad = (rise > 0.3 + SPARE) | (slope > np.tan(np.radians(10.0 + SPARE_DEG)))
    if not bad.any():
        return len(places), ""
    told = found.risk[row, column][bad].min()
    return len(places), f"{bad.sum()} of {len(places)}, told {told:.1e}"


@pytest.mark.quick("strips", "few looks")
@pytest.mark.parametrize("kind", KINDS)
def test_no_rock_that_was_measured_is_stood_on(kind):
    """However it was seen."""
    judged, wrong = 0, []
    for seed in range(12):
        rng = np.random.default_rng([seed, KINDS.index(kind)])
        config, (scene, high) = configured(rng), strewn(rng, kind)
        seen = views(rng, scene, kind)
        count, fault = stood_on(config, seen, well_seen(scene, high, seen))
        judged += count
        wrong += [f"seed {seed}: {fault}"] * bool(fault)
    assert judged > 100
    assert not wrong, wrong


@pytest.mark.parametrize("drop", ["ditch", "step"])
def test_nobody_stands_where_a_drop_hides_its_ground(drop):
    """0.6 m deep, seen often, from one side alone: the far wall, and nothing below the near rim."""
    judged, wrong = 0, []
    for seed in range(4):
        rng = np.random.default_rng([seed, 8])
        config, rim = configured(rng), rng.uniform(-1.0, 1.0)
        boxes = [[-30.0, -30.0, -1.0, rim, 30.0, 0.6], [rim + 0.5, -30.0, -1.0, 30.0, 30.0, 0.6]]
        scene = Scene(boxes=np.array(boxes if drop == "ditch" else boxes[:1]))
        seen, rays = [], fan(8.0, 96)
        for k in range(30):
            up, turn = np.radians(rng.uniform(22.0, 35.0)), rng.normal(0.0, 0.2)
            target = np.array([*rng.uniform(-AREA, AREA, 2), 0.6])
            ahead = np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), -np.sin(up)
            position = target - 100.0 * np.array(ahead)
            seen.append(view(scene, position, target, rays, NOISE, rng, 1.0 + 0.05 * k))
        count, fault = stood_on(config, seen, scene)
        judged += count
        wrong += [f"seed {seed}: {fault}"] * bool(fault)
    assert judged > 100
    assert not wrong, wrong


@pytest.mark.quick("strips", "few looks")
@pytest.mark.parametrize("kind", KINDS)
def test_no_height_is_beyond_what_was_measured(kind):
    """Trees, walls and steps: planes end where measurements end; within 1 m, give or take noise."""
    wrong = []
    for seed in range(6):
        rng = np.random.default_rng([seed, 7, KINDS.index(kind)])
        config, scene = configured(rng), overgrown(rng)
        seen = views(rng, scene, kind)
        cells = mapped(config, seen)
        raster = rasterise(cells, config.lss)
        row, column = np.nonzero(raster.observed & np.isfinite(raster.elevation))
        z = raster.elevation[row, column]
        side = cells.domain.finest_size
        x, y = cells.domain.xmin + side * (column + 0.5), cells.domain.ymin + side * (row + 0.5)
        low, high = within(points_of(seen), x, y)
        excess = np.fmax(z - high, low - z)
        if np.nanmax(excess) > 5.0 * NOISE:
            wrong.append(f"seed {seed}: {(excess > 0.3).sum()}, by {np.nanmax(excess):.2f} m")
    assert not wrong, wrong


def within(points: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest of points (N, 3) within 1 m of places (K,), to 0.1 m; NaN for none."""
    points = points[np.isfinite(points).all(axis=1)]
    corner = np.minimum(points[:, :2].min(axis=0), [x.min(), y.min()])
    of_points, of_places = ((v - corner) // 0.1 for v in (points[:, :2], np.column_stack([x, y])))
    of_points, of_places = (v.astype(int).T for v in (of_points, of_places))
    shape = np.maximum(of_points.max(axis=1), of_places.max(axis=1)) + 1
    disc = np.hypot(*np.mgrid[-10:11, -10:11]) <= 10.0
    low, high = np.full(shape, np.inf), np.full(shape, -np.inf)
    np.minimum.at(low, tuple(of_points), points[:, 2])
    np.maximum.at(high, tuple(of_points), points[:, 2])
    low = minimum_filter(low, footprint=disc, mode="constant", cval=np.inf)[tuple(of_places)]
    high = maximum_filter(high, footprint=disc, mode="constant", cval=-np.inf)[tuple(of_places)]
    return np.where(low > high, np.nan, low), np.where(low > high, np.nan, high)


def overgrown(rng: np.random.Generator) -> Scene:
    """Trees of 2 to 6 m and walls on inclined ground."""
    gradient = tuple(rng.uniform(-0.2, 0.2, 2))
    plane = Scene(gradient)
    places = rng.uniform(-AREA, AREA, (8, 2))
    ground = plane.plane(*places.T)
    cones = np.column_stack([places, ground, rng.uniform(0.5, 1.5, 8), rng.uniform(2.0, 6.0, 8)])
    middle, half = rng.uniform(-AREA, AREA, (2, 2)), rng.uniform(0.2, 2.0, (2, 2))
    low = plane.plane(*middle.T) - 2.0
    boxes = np.column_stack([middle - half, low, middle + half, low + rng.uniform(3.0, 5.0, 2)])
    return Scene(gradient, np.zeros((0, 4)), cones, boxes)
