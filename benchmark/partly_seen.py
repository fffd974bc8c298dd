# SPDX-License-Identifier: Apache-2.0
"""True safety of grid points that are called safe on partly observed ground.

The scenes are analytic (`common.rays`): edges of the scanned area, small footprints, fields of
rocks, drops and posts.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import configuration, machine, table
from common.rays import EXACT, Scene, View, fan, rocks, view

from quadtree_lss.lab.simulation.safety import LandingGear, worst_contact
from quadtree_lss.lab.simulation.terrain import Terrain
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.geometry.rotations import exp
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.tree.cell_map import CellMap

NOISE = 0.06
#: Distance of the posts of the true ground, m.
POST = 0.05
FLASH = fan(1.0, 128)


def main() -> None:
    """Print a table for each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--case", choices=CASES, nargs="+", default=list(CASES))
    parser.add_argument("--seeds", type=int, nargs="+", help="by default those of each case")
    parser.add_argument("--quick", action="store_true", help="a small part of each case")
    options = parser.parse_args()
    print(machine())
    for name in options.case:
        CASES[name](options.seeds, options.quick)


@dataclass(frozen=True)
class Verdict:
    """Grid points of a map that are called safe; positions (K, 2) of those that are truly unsafe,
    and the lowest predicted risk of these, infinite without any."""

    safe: int
    unsafe: Array
    risk: float


HEADER = ["maps", "safe", "unsafe", "%", "least risk"]


def row(verdicts: list[Verdict]) -> list[object]:
    """Sums over maps, as `HEADER` names them."""
    safe, unsafe = sum(v.safe for v in verdicts), sum(len(v.unsafe) for v in verdicts)
    risk = min(v.risk for v in verdicts)
    least = f"{risk:.1e}" if np.isfinite(risk) else "-"
    return [len(verdicts), safe, unsafe, f"{100 * unsafe / max(safe, 1):.2f}", least]


def verdict(cells: CellMap, config: Config, scene: Scene) -> Verdict:
    """Set the lander down on the true ground wherever the map calls it safe."""
    assessment, gear = LandingSiteSelector(config).assess(cells), LandingGear()
    j, i = np.nonzero(assessment.safe)
    places = np.column_stack([assessment.x[i], assessment.y[j]])
    if not len(places):
        return Verdict(0, places, np.inf)
    reach = gear.reach + 0.5
    x, y = (np.arange(v.min() - reach, v.max() + reach, POST) for v in places.T)
    slope, rises = worst_contact(Terrain(x, y, scene.dem(x, y)), places, gear)
    unsafe = (slope > np.tan(np.radians(gear.max_slope_deg))) | (rises > gear.max_roughness)
    risk = assessment.risk[j[unsafe], i[unsafe]].min(initial=np.inf)
    return Verdict(len(unsafe), places[unsafe], float(risk))


def mapped(config: Config, views: list[View]) -> CellMap:
    """Map views in order."""
    mapper = Mapper(config)
    for one in views:
        mapper.update(one.points, one.pose)
    return mapper.snapshot()


def from_glide_slope(target: Array, heading: float, slant: float, slope_deg: float) -> Array:
    """Position of a lidar that points at (2,) on z = 0 from a glide slope."""
    slope = np.radians(slope_deg)
    back = -np.cos(slope) * np.array([np.cos(heading), np.sin(heading)])
    return np.array([*(target + slant * back), slant * np.sin(slope)])


def edge(seeds: list[int] | None, quick: bool) -> None:
    """A rock at the edge of the scanned ground, in a partly observed leaf."""
    rows = []
    for level, border, edges in (
        (4, 20.0, (20.8, 21.3, 21.8, 20.4, 22.4, 23.2)),
        (3, 16.0, (17.0, 18.0, 19.2, 21.0)),
        (5, 20.0, (20.5, 20.8, 21.3)),
    ):
        config = configuration("flight", domain__min_level=level)
        for at in edges[:3] if quick else edges:
            verdicts = []
            for seed in seeds or range(401, 403 if quick else 409):
                rng = np.random.default_rng([seed, level, round(100 * at)])
                verdicts.append(scan_edge(rng, config, border, at))
            rows.append([f"{config.domain.size / 2**level:g}", f"{at:g}", *row(verdicts)])
    title = "edge: rock of 0.45 m at the edge of the scanned ground; grid points called safe"
    table(title, ["leaf m", "edge m", *HEADER], rows)


def scan_edge(rng: np.random.Generator, config: Config, border: float, at: float) -> Verdict:
    """Scan the ground up to ``at``; the rock stands within the leaf that begins at ``border``."""
    low, high = border + 0.25, max(at - 0.1, border + 0.3)
    side = config.domain.size / 2**config.domain.min_level
    place = np.array([low + (high - low) * rng.random(), side * rng.random() - 0.5 * side])
    scene = Scene(spheres=rocks(place[None], 0.45, 0.45))
    # The edge is at random in the east or in the north.
    heading, turned = 2.0 * np.pi * rng.random(), rng.random() < 0.5
    if turned:
        scene = Scene(spheres=scene.spheres[:, [1, 0, 2, 3]])
    views = []
    for k, (along, across) in enumerate(np.ndindex(6, 7)):
        target = np.array([at - 1.0 - 2.5 * along, 9.0 - 3.0 * across]) + rng.normal(0, 0.3, 2)
        target = target[::-1] if turned else target
        from_there = from_glide_slope(target, heading, 300.0, 35.0)

        def keep(x: Array, y: Array) -> Array:
            return (y if turned else x) < at

        rays, aim = FLASH, np.array([*target, 0.0])
        views.append(view(scene, from_there, aim, rays, NOISE, rng, 1.0 + 0.05 * k, keep=keep))
    return verdict(mapped(config, views), config, scene)


def footprints(seeds: list[int] | None, quick: bool) -> None:
    """A low lidar, whose footprints are smaller than a coarse cell."""
    rows = []
    low = ((60.0, 8.0), (100.0, 12.0)) if quick else ((28.65, 10.0), (60.0, 16.0))
    heights = low if quick else (*low, (100.0, 24.0), (150.0, 24.0))
    for rock in (0.9, 0.42):
        for above, side in heights:
            for seed in seeds or [411]:
                rng = np.random.default_rng(seed)
                scene, views = small_footprints(rng, rock, above, 0.5 * side)
                for level in (4, 5):
                    config = configuration("flight", domain__min_level=level)
                    one = verdict(mapped(config, views), config, scene)
                    coarsest = config.domain.size / 2**level
                    given = (rock, above, side, coarsest)
                    rows.append([*(f"{v:g}" for v in given), len(views), *row([one])])
    table(
        "footprints: 1 degree straight down, three coverings, rocks every 4 m",
        ["rocks m", "up m", "area m", "coarsest m", "scans", *HEADER],
        rows,
    )


def small_footprints(
    rng: np.random.Generator, rock: float, above: float, half: float
) -> tuple[Scene, list[View]]:
    """Rocks of one height, and scans that cover a square three times."""
    reach = np.arange(-half - 6.0, half + 6.1, 4.0) + rng.uniform(-2.0, 2.0)
    places = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    places += rng.uniform(-0.3, 0.3, places.shape)
    scene, views = Scene(spheres=rocks(places, rock, rock)), list[View]()
    width = 2.0 * above * np.tan(np.radians(0.5))
    for covering in range(3):
        steps = np.arange(-half, half + 0.85 * width, 0.85 * width)
        for k, across in enumerate(steps):
            for along in steps[:: 1 if k % 2 else -1]:
                aim = np.array([along, across] if covering % 2 else [across, along])
                aim += rng.normal(0.0, 0.05 * width, 2)
                position, stamp = np.array([*aim, above]), 1.0 + 0.05 * len(views)
                views.append(view(scene, position, [*aim, 0.0], FLASH, NOISE, rng, stamp))
    return scene, views


def inside(seeds: list[int] | None, quick: bool) -> None:
    """Fields of rocks, 180 scans over 40 x 40 m."""
    config, rows = configuration("flight"), []
    for seed in seeds or range(421, 423 if quick else 431):
        rng = np.random.default_rng(seed)
        count = int(rng.integers(20, 80))
        low, high = rng.uniform(0.05, 0.25, 2 * count), rng.uniform(0.25, 0.5, count)
        high = np.concatenate([high, low])
        places = rng.uniform(-20.0, 20.0, (len(high), 2))
        flat = Scene(gradient=tuple(np.tan(np.radians(rng.uniform(-4.0, 4.0, 2)))))
        spheres = rocks(places, high, high * rng.uniform(0.8, 1.4, len(high)), flat)
        scene, heading = replace(flat, spheres=spheres), 2.0 * np.pi * rng.random()
        mapper = Mapper(config)
        for k in range(180):
            aim = rng.uniform(-20.0, 20.0, 2)
            turn = heading + rng.normal(0.0, 0.1)
            position = from_glide_slope(aim, turn, rng.uniform(100.0, 300.0), 35.0)
            aim = np.array([*aim, float(flat.plane(*aim))])
            one = view(scene, position, aim, FLASH, NOISE, rng, 1.0 + 0.05 * k)
            mapper.update(one.points, one.pose)
        rows.append([seed, len(high), *row([verdict(mapper.snapshot(), config, scene)])])
    title = "inside: 180 scans over 40 x 40 m of rocks up to 0.5 m; grid points called safe"
    table(title, ["seed", "rocks", *HEADER], rows)


def drops(seeds: list[int] | None, quick: bool) -> None:
    """Ditches, steps and pits, scanned often, but only from one side: no returns from their
    floors."""
    domain = {"domain__xmin": -16.0, "domain__ymin": -16.0, "domain__size": 32.0}
    config = configuration("flight", **domain, domain__min_level=3, domain__max_level=7)
    rows, rays = [], fan(8.0, 96)
    for kind in ("ditch", "step", "pits"):
        for incidence in (30, 60) if quick else (20, 30, 40, 50, 60, 70):
            verdicts = []
            for seed in seeds or range(5201, 5203 if quick else 5213):
                rng = np.random.default_rng([seed, incidence])
                scene, top = drop_scene(rng, kind)
                heading, mapper = rng.uniform(-1.0, 1.0), Mapper(config)
                for k in range(40):
                    aim = rng.uniform(-6.0, 6.0, 2)
                    turn = heading + rng.normal(0.0, 0.1)
                    position = from_glide_slope(aim, turn, 100.0, 90.0 - incidence)
                    position[2] += top
                    one = view(scene, position, [*aim, top], rays, NOISE, rng, 1.0 + 0.05 * k)
                    mapper.update(one.points, one.pose)
                verdicts.append(verdict(mapper.snapshot(), config, scene))
            rows.append([kind, incidence, *row(verdicts)])
    table(
        "drops of 0.4-0.8 m, 0.4-1 m wide, seen in 40 scans from one side; grid points called safe",
        ["", "incidence, deg", *HEADER],
        rows,
    )


def drop_scene(rng: np.random.Generator, kind: str) -> tuple[Scene, float]:
    """Level ground over a plane, with holes down to it; and how high that ground is, m."""
    deep, wide, far = rng.uniform(0.4, 0.8), rng.uniform(0.4, 1.0), 30.0
    if kind == "pits":
        rows = np.linspace(-7.0, 7.0, 4) + rng.uniform(-1.0, 1.0, 4)
        ends = np.concatenate([[-far], np.column_stack([rows, rows + wide]).ravel(), [far]])
        # Between rows of pits the ground runs through, in a row from pit to pit.
        boxes = [[-far, a, -1.0, far, b, deep] for a, b in ends.reshape(-1, 2)]
        for south in rows:
            along = np.linspace(-7.0, 7.0, 4) + rng.uniform(-1.0, 1.0, 4)
            ends = np.concatenate([[-far], np.column_stack([along, along + wide]).ravel(), [far]])
            boxes += [[a, south, -1.0, b, south + wide, deep] for a, b in ends.reshape(-1, 2)]
    else:
        rim = rng.uniform(-2.0, 2.0)
        boxes = [[-far, -far, -1.0, rim, far, deep]]
        boxes += [[rim + wide, -far, -1.0, far, far, deep]] if kind == "ditch" else []
    return Scene(boxes=np.array(boxes)), deep


def posts(seeds: list[int] | None, quick: bool) -> None:
    """Posts under a lidar that hovers: beams 0.45 m apart, nearly the same ones in every scan."""
    domain = {"domain__xmin": -16.0, "domain__ymin": -16.0, "domain__size": 32.0}
    levels = {"domain__min_level": 3, "domain__max_level": 7}
    config = configuration("flight", **domain, **levels, pose__correlation_time=0.0)
    rows, rays = [], fan(16.0, 64)
    for sway, attitude in ((0.0, 0.0), (0.03, 0.0), (0.1, 0.0), (0.3, 0.0), (0.0, 2.0), (0.1, 2.0)):
        verdicts = []
        covariance = EXACT + np.diag([0.0] * 3 + [(1e-3 * attitude) ** 2] * 3)
        for seed in seeds or range(5301, 5303 if quick else 5313):
            rng = np.random.default_rng([seed, round(1000 * sway), round(attitude)])
            at, high = rng.uniform(-14.0, 14.0, (60, 2)), rng.uniform(0.32, 0.5, 60)
            wide = np.full((60, 1), 0.15)
            corners = [at - wide, -np.ones((60, 1)), at + wide, high[:, None]]
            scene, mapper = Scene(boxes=np.hstack(corners)), Mapper(config)
            for k in range(100):
                place, aim = rng.normal(0.0, sway, (2, 2))
                position, target = np.array([*place, 100.0]), np.array([*aim, 0.0])
                one = view(scene, position, target, rays, NOISE, rng, 1.0 + 0.05 * k)
                error = exp(1e-3 * rng.normal(0.0, attitude, 3))
                turned = error @ one.pose.rotation_map_lidar
                pose = Pose(one.pose.stamp_ns, position, turned, covariance)
                mapper.update(one.points, pose)
            verdicts.append(verdict(mapper.snapshot(), config, scene))
        rows.append([f"{sway:g}", f"{attitude:g}", *row(verdicts)])
    table(
        "posts of 0.32-0.5 m, 100 scans of a hover; grid points called safe",
        ["sway, m", "attitude error, mrad", *HEADER],
        rows,
    )


CASES = {"edge": edge, "footprints": footprints, "inside": inside, "drops": drops, "posts": posts}


if __name__ == "__main__":
    main()
