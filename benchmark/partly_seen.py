# SPDX-License-Identifier: Apache-2.0
"""Grid points called safe on ground that was observed in part, judged by the true ground.

All scenes are closed formulas (`common.rays`): edges of the scanned area, small footprints, fields
of rocks, and drops.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import configuration, machine, table
from common.rays import Scene, View, fan, rocks, view

from quadtree_lss.lab.simulation.safety import LandingGear, worst_contact
from quadtree_lss.lab.simulation.terrain import Terrain
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing import hazards
from quadtree_lss.onboard.core.landing.sites import LandingAssessment, LandingSiteSelector
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.tree.cell_map import CellMap

NOISE = 0.06
#: m: posts of the true ground that the lander is set down on.
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
        began = time.process_time()
        CASES[name](options.seeds, options.quick)
        print(f"({name}: {time.process_time() - began:.0f} s)", flush=True)


@dataclass(frozen=True)
class Verdict:
    """What landing says of a map, against the truth.

    Attributes:
        found: The assessment.
        safe: Grid points called safe.
        wrong: (K, 2) places of those that are not.
        rise: By how much the ground rises above the lander's pads at the worst of them, m.
        risk: Least risk told for these, NaN for none.
        aim: Greatest probability told for these, NaN for none.
    """

    found: LandingAssessment
    safe: int
    wrong: Array
    rise: float
    risk: float
    aim: float


def verdict(cells: CellMap, config: Config, scene: Scene) -> Verdict:
    """Set the lander down on the true ground wherever the map calls it safe."""
    found = LandingSiteSelector(config).assess(cells)
    row, column = np.nonzero(found.safe)
    places = np.column_stack([found.x[column], found.y[row]])
    if not len(places):
        return Verdict(found, 0, places, np.nan, np.nan, np.nan)
    reach = 0.5 * LandingGear().diameter + 0.5
    x, y = (np.arange(v.min() - reach, v.max() + reach, POST) for v in places.T)
    slope, rises = worst_contact(Terrain(x, y, scene.dem(x, y)), places, LandingGear())
    gear = LandingGear()
    wrong = (slope > np.tan(np.radians(gear.max_slope_deg))) | (rises > gear.max_roughness)
    row, column, some = row[wrong], column[wrong], wrong.any()
    rise = rises[wrong].max() if some else np.nan
    risk = found.risk[row, column].min() if some else np.nan
    aim = found.probability[row, column].max() if some else np.nan
    return Verdict(found, len(wrong), places[wrong], rise, risk, aim)


def mapped(config: Config, views: list[View]) -> CellMap:
    """All views in order."""
    mapper = Mapper(config)
    for one in views:
        mapper.update(one.points, one.pose)
    return mapper.snapshot()


def told(value: float, form: str = ".1e") -> str:
    """A number, or a dash for none."""
    return format(value, form) if np.isfinite(value) else "-"


def from_glide_slope(target: Array, heading: float, slant: float, slope_deg: float) -> Array:
    """Where a lidar stands that looks at a place (2,) on z = 0."""
    slope = np.radians(slope_deg)
    back = -np.cos(slope) * np.array([np.cos(heading), np.sin(heading)])
    return np.array([*(target + slant * back), slant * np.sin(slope)])


def edge(seeds: list[int] | None, quick: bool) -> None:
    """A rock where the scanned ground ends, in a leaf of which a part was seen."""
    rows = []
    for level, border, edges in (
        (4, 20.0, (20.8, 21.3, 21.8, 20.4, 22.4, 23.2)),
        (3, 16.0, (17.0, 18.0, 19.2, 21.0)),
        (5, 20.0, (20.5, 20.8, 21.3)),
    ):
        config = configuration("flight", domain__min_level=level)
        for at in edges[:3] if quick else edges:
            verdicts, returns, hit = [], [], 0
            for seed in seeds or range(401, 403 if quick else 409):
                rng = np.random.default_rng([seed, level, round(100 * at)])
                one, count = one_edge(rng, config, border, at)
                verdicts.append(one)
                returns.append(count)
                hit += len(one.wrong) > 0
            rows.append(
                [f"{config.domain.size / 2**level:g}", f"{at:g}", len(verdicts)]
                + [min(returns), sum(v.safe for v in verdicts), hit]
                + [sum(len(v.wrong) for v in verdicts), most(verdicts)]
                + [told(np.nanmin([v.risk for v in verdicts] + [np.inf]))]
                + [told(np.nanmax([v.aim for v in verdicts] + [-np.inf]), ".4f")]
            )
    table(
        "edge: rock of 0.45 m at the edge of what was scanned; grid points called safe",
        ["leaf m", "edge m", "draws", "returns, least", "safe", "draws with unsafe ones", "unsafe"]
        + ["most in a draw", "least risk", "best aim"],
        rows,
    )


def most(verdicts: list[Verdict]) -> int:
    """Of unsafe points in one map."""
    return max(len(v.wrong) for v in verdicts)


def one_edge(
    rng: np.random.Generator, config: Config, border: float, at: float
) -> tuple[Verdict, int]:
    """Ground is scanned up to ``at``; the rock stands within the leaf that begins at ``border``."""
    low, high = border + 0.25, max(at - 0.1, border + 0.3)
    side = config.domain.size / 2**config.domain.min_level
    place = np.array([low + (high - low) * rng.random(), side * rng.random() - 0.5 * side])
    scene = Scene(spheres=rocks(place[None], 0.45, 0.45))
    # The edge is east, or north: along or across the line of sight.
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
    returns = sum(int((one.hit >= 0).sum()) for one in views)
    return verdict(mapped(config, views), config, scene), returns


def footprints(seeds: list[int] | None, quick: bool) -> None:
    """A lidar low over the ground: footprints smaller than a coarse cell."""
    rows = []
    low = ((60.0, 8.0), (100.0, 12.0)) if quick else ((28.65, 10.0), (60.0, 16.0))
    heights = low if quick else (*low, (100.0, 24.0), (150.0, 24.0))
    for kind in ("boulders", "rocks of 0.42 m"):
        for above, half in heights:
            for seed in seeds or [411]:
                rows += small_footprints(np.random.default_rng(seed), kind, above, 0.5 * half)
    table(
        "footprints: 1 degree straight down, three coverings, rocks every 4 m",
        ["", "up m", "footprint m", "area m", "scans", "coarsest m", "leaves", "measured"]
        + ["judged %", "safe", "unsafe", "least risk", "ms a scan"],
        rows,
    )


def small_footprints(
    rng: np.random.Generator, kind: str, above: float, half: float
) -> list[list[object]]:
    """Rows for coarsest cells of 4 m and 2 m, of the same scans."""
    reach = np.arange(-half - 6.0, half + 6.1, 4.0) + rng.uniform(-2.0, 2.0)
    places = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    places += rng.uniform(-0.3, 0.3, places.shape)
    height = 0.42 if kind.startswith("rocks") else 0.9
    scene = Scene(spheres=rocks(places, height, height))
    width = 2.0 * above * np.tan(np.radians(0.5))
    configs = [configuration("flight", domain__min_level=level) for level in (4, 5)]
    mappers, spent, scans = [Mapper(c) for c in configs], [0.0, 0.0], 0
    for covering in range(3):
        steps = np.arange(-half, half + 0.85 * width, 0.85 * width)
        for k, across in enumerate(steps):
            for along in steps[:: 1 if k % 2 else -1]:
                aim = np.array([along, across] if covering % 2 else [across, along])
                aim += rng.normal(0.0, 0.05 * width, 2)
                position = np.array([*aim, above])
                stamp = 1.0 + 0.05 * scans
                one = view(scene, position, [*aim, 0.0], FLASH, NOISE, rng, stamp)
                scans += 1
                for n, mapper in enumerate(mappers):
                    began = time.process_time()
                    mapper.update(one.points, one.pose)
                    spent[n] += time.process_time() - began
    rows = []
    for mapper, config, seconds in zip(mappers, configs, spent, strict=True):
        cells = mapper.snapshot()
        one = verdict(cells, config, scene)
        inner = np.ix_(*(np.abs(axis) < half - 2.35 for axis in (one.found.y, one.found.x)))
        judged = (one.found.hazard & hazards.UNSEEN == 0)[inner].mean()
        rows.append(
            [kind, f"{above:g}", f"{width:.2f}", f"{2 * half:g}", scans]
            + [f"{config.domain.size / 2**config.domain.min_level:g}", len(cells.z)]
            + [int(cells.measured.sum()), f"{100 * judged:.1f}", one.safe, len(one.wrong)]
            + [told(one.risk), f"{1e3 * seconds / scans:.2f}"]
        )
    return rows


def inside(seeds: list[int] | None, quick: bool) -> None:
    """Fields of rocks, 180 scans over 40 x 40 m: rocks of 0.25-0.5 m with 50 returns and more."""
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
        returns, mapper = np.zeros(len(high), dtype=int), Mapper(config)
        for k in range(180):
            aim = rng.uniform(-20.0, 20.0, 2)
            turn = heading + rng.normal(0.0, 0.1)
            position = from_glide_slope(aim, turn, rng.uniform(100.0, 300.0), 35.0)
            aim = np.array([*aim, float(flat.plane(*aim))])
            one = view(scene, position, aim, FLASH, NOISE, rng, 1.0 + 0.05 * k)
            returns += np.bincount(one.hit[one.hit >= 0], minlength=len(high))
            mapper.update(one.points, one.pose)
        found = verdict(mapper.snapshot(), config, scene)
        # The rock that is nearest, rim to place, of those that matter.
        matter = high >= 0.25
        blame = np.hypot(*(found.wrong[:, None] - places[matter]).T) - high[matter][:, None]
        blame = np.bincount(blame.argmin(axis=0), minlength=matter.sum()) * (returns[matter] >= 50)
        rows.append(
            [seed, len(high), int((returns[matter] >= 50).sum()), found.safe, len(found.wrong)]
            + [int(blame.sum()), int((blame > 0).sum()), told(found.rise, ".2f"), told(found.risk)]
        )
    table(
        "inside: 180 scans over 40 x 40 m; rocks of 0.25-0.5 m with 50 returns and more",
        ["seed", "rocks", "of these", "safe", "unsafe", "by these", "rocks to blame"]
        + ["worst rise m", "least risk"],
        rows,
    )


def drops(seeds: list[int] | None, quick: bool) -> None:
    """Ditches, steps and pits, seen often and from one side alone: no return from their floors."""
    domain = {"domain__xmin": -16.0, "domain__ymin": -16.0, "domain__size": 32.0}
    config = configuration("flight", **domain, domain__min_level=3, domain__max_level=7)
    rows, rays = [], fan(8.0, 96)
    for kind in ("ditch", "step", "pits"):
        for incidence in (30, 60) if quick else (20, 30, 40, 50, 60, 70):
            verdicts = []
            for seed in seeds or range(5201, 5203 if quick else 5213):
                rng = np.random.default_rng([seed, incidence])
                scene, top = dropping(rng, kind)
                heading, mapper = rng.uniform(-1.0, 1.0), Mapper(config)
                for k in range(40):
                    aim = rng.uniform(-6.0, 6.0, 2)
                    turn = heading + rng.normal(0.0, 0.1)
                    position = from_glide_slope(aim, turn, 100.0, 90.0 - incidence)
                    position[2] += top
                    one = view(scene, position, [*aim, top], rays, NOISE, rng, 1.0 + 0.05 * k)
                    mapper.update(one.points, one.pose)
                verdicts.append(verdict(mapper.snapshot(), config, scene))
            safe, wrong = sum(v.safe for v in verdicts), sum(len(v.wrong) for v in verdicts)
            rows.append(
                [kind, incidence, len(verdicts), safe, wrong, f"{100 * wrong / max(safe, 1):.2f}"]
                + [told(np.nanmin([v.risk for v in verdicts] + [np.inf]))]
            )
    table(
        "drops of 0.4-0.8 m, 0.4-1 m wide, seen in 40 scans from one side; grid points called safe",
        ["", "incidence, deg", "maps", "safe", "unsafe", "%", "least risk"],
        rows,
    )


def dropping(rng: np.random.Generator, kind: str) -> tuple[Scene, float]:
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
    config = configuration("flight", **domain, domain__min_level=3, domain__max_level=7)
    rows, rays = [], fan(16.0, 64)
    for sway in (0.0, 0.03, 0.1, 0.3):
        verdicts = []
        for seed in seeds or range(5301, 5303 if quick else 5313):
            rng = np.random.default_rng([seed, round(1000 * sway)])
            at, high = rng.uniform(-14.0, 14.0, (60, 2)), rng.uniform(0.32, 0.5, 60)
            wide = np.full((60, 1), 0.15)
            corners = [at - wide, -np.ones((60, 1)), at + wide, high[:, None]]
            scene, mapper = Scene(boxes=np.hstack(corners)), Mapper(config)
            for k in range(100):
                place, aim = rng.normal(0.0, sway, (2, 2))
                position, target = np.array([*place, 100.0]), np.array([*aim, 0.0])
                one = view(scene, position, target, rays, NOISE, rng, 1.0 + 0.05 * k)
                mapper.update(one.points, one.pose)
            verdicts.append(verdict(mapper.snapshot(), config, scene))
        safe, wrong = sum(v.safe for v in verdicts), sum(len(v.wrong) for v in verdicts)
        least = told(np.nanmin([v.risk for v in verdicts] + [np.inf]))
        share = f"{100 * wrong / max(safe, 1):.2f}"
        rows.append([f"{sway:g}", len(verdicts), safe, wrong, share, least])
    table(
        "posts of 0.32-0.5 m, 100 scans of a hover; grid points called safe",
        ["sway, m", "maps", "safe", "unsafe", "%", "least risk"],
        rows,
    )


CASES = {"edge": edge, "footprints": footprints, "inside": inside, "drops": drops, "posts": posts}


if __name__ == "__main__":
    main()
