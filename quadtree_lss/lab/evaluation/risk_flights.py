# SPDX-License-Identifier: Apache-2.0
"""Flies over simulated fields, in memory, and fits how a map's worst rests tell of true ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

import quadtree_lss
from quadtree_lss import build
from quadtree_lss.desk.bags.bag import MessageBag, Topic
from quadtree_lss.desk.replay.scans import steps
from quadtree_lss.lab.evaluation.metrics import scores
from quadtree_lss.lab.evaluation.results import EvaluationError
from quadtree_lss.lab.evaluation.risk_fit import (
    ABOUT_BINS,
    OWN_BINS,
    RISE_BINS,
    SLOPE_BINS,
    counted,
    fit_curves,
    fit_tables,
    rounded,
    unfitted,
)
from quadtree_lss.lab.simulation.hazard_field import FIELDS, hazard_field
from quadtree_lss.lab.simulation.recording import POSE_TOPIC, SCAN_TOPIC, TYPES
from quadtree_lss.lab.simulation.safety import LandingGear, contact_safe, on_dem
from quadtree_lss.lab.simulation.simulation import Simulation
from quadtree_lss.lab.simulation.terrain import Terrain
from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.config.risk import RiskModel
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.probability import RiskTable, limits
from quadtree_lss.onboard.core.landing.raster import rasterise
from quadtree_lss.onboard.core.landing.score import look_around
from quadtree_lss.onboard.core.landing.touchdown import TouchdownCheck, WorstContact
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.messages.maps import round_trip

#: Parts of a flight after which its map is judged.
PARTS = (0.35, 0.65, 1.0)


@dataclass(frozen=True)
class Conditions:
    """Of flights that count alike.

    Attributes:
        field: Name in ``FIELDS``.
        noise: Of a range, as a multiple of ``lidar.range_noise``.
        outliers: Share of false returns.
        told: Whether the mapping knows of the noise.
    """

    field: str = "default"
    noise: float = 1.0
    outliers: float = 0.0
    told: bool = True

    def mapping(self, config: Config) -> Config:
        """The configuration that the flight is mapped with."""
        noise = config.lidar.range_noise * (self.noise if self.told else 1.0)
        return replace(config, lidar=replace(config.lidar, range_noise=noise))


#: The greater range noise that is flown with, as a multiple of the usual one.
NOISIER = 4.0 / 3.0
CASES = {
    **{name: Conditions(name) for name in FIELDS},
    "told": Conditions(noise=NOISIER, outliers=0.02),
    "untold": Conditions(noise=NOISIER, outliers=0.02, told=False),
}


@dataclass(frozen=True)
class Mapped:
    """A map at a time of a flight, and what was true at the grid points of its finest lattice.

    Attributes:
        cells: The map, as its message gives it.
        known: (n + 1, n + 1) grid points in the scanned box and on the true terrain.
        safe: (n + 1, n + 1) of them, where the lander stands safely.
    """

    cells: CellMap
    known: Mask
    safe: Mask


def fly(
    terrain: Terrain, seed: int, conditions: Conditions, config: Config, parts: Sequence[float]
) -> list[Mapped]:
    """A simulated flight, mapped, after each of some parts of it."""
    simulation = Simulation(
        "morpheus",
        seed,
        terrain=terrain,
        range_noise=conditions.noise * config.lidar.range_noise,
        outliers=conditions.outliers,
    )
    marks = {max(1, round(part * simulation.scans)) for part in parts}
    found: list[CellMap] = []
    mapper: Mapper | None = None
    number = 0
    for number, (_, _, mapper) in enumerate(
        steps(in_memory(simulation), conditions.mapping(config)), 1
    ):
        if number in marks:
            found.append(round_trip(mapper.snapshot()))
    if mapper is not None and number not in marks:  # the last scans may lack a pose
        found.append(round_trip(mapper.snapshot()))
    if not found:
        return []
    known, safe = _truth(found[-1], simulation, config)
    return [Mapped(cells, known, safe) for cells in found]


def in_memory(simulation: Simulation) -> MessageBag:
    """A simulated flight as a bag that is no file, for once."""
    counts = {SCAN_TOPIC: simulation.scans, POSE_TOPIC: simulation.poses}
    topics = [Topic(name, kind, counts[name]) for name, kind in TYPES.items()]
    return MessageBag("bag", topics, simulation.span_ns, simulation.messages())


def lander_of(config: Config) -> LandingGear:
    """The vehicle that the parameters describe: whose safety is judged, and is true."""
    lss = config.lss
    return LandingGear(
        diameter=lss.vehicle_diameter,
        pad_radius=lss.pad_radius,
        max_slope_deg=lss.max_slope_deg,
        max_roughness=lss.max_roughness,
    )


def _truth(cells: CellMap, simulation: Simulation, config: Config) -> tuple[Mask, Mask]:
    """Grid points whose truth is known, and of them those that are safe."""
    domain, (xmin, xmax, ymin, ymax) = cells.domain, simulation.box
    along = domain.finest_size * np.arange(domain.finest_count + 1)
    x, y = domain.xmin + along, domain.ymin + along
    in_x = (x >= xmin - 1e-9) & (x <= xmax + 1e-9)
    known = ((y >= ymin - 1e-9) & (y <= ymax + 1e-9))[:, None] & in_x
    dem, lander = simulation.legs[0].plan.truth, lander_of(config)
    points = np.stack(np.meshgrid(x, y), axis=-1)
    known[known] = on_dem(dem.x, dem.y, points[known], lander)
    safe = np.zeros(known.shape, dtype=np.bool_)
    safe[known] = contact_safe(dem.x, dem.y, dem.elevation, points[known], lander)
    return known, safe


@dataclass(frozen=True)
class Landings:
    """Landings at the grid points of a map.

    Attributes:
        worst: The worst contacts on the map.
        judged: (n + 1, n + 1) where all ground under the lander is seen.
        counts: (n + 1, n + 1) of these, where the truth is known.
        slope: (n + 1, n + 1) of the ground at the lander's scale, rad.
        failed: (K,) of ``counts``: whether the lander fails there.
        noise: Configured range noise of the mapping, m.
    """

    worst: WorstContact
    judged: Mask
    counts: Mask
    slope: Array
    failed: Mask
    noise: float


def land(mapped: Mapped, model: RiskModel, config: Config) -> Landings:
    """Sets the lander down on a map at every grid point, with the limits of a model."""
    lss = config.lss
    raster = rasterise(mapped.cells, lss)
    around = look_around(raster, lss)
    worst = TouchdownCheck(lss, limits(model, lss)).worst(raster, around.judged)
    counts, noise = around.judged & mapped.known, config.lidar.range_noise
    failed = ~mapped.safe[counts]
    return Landings(worst, around.judged, counts, around.planes.slope, failed, noise)


Progress = Callable[[int, int], None]


def fit_risk(
    config: Config,
    seeds: Sequence[int],
    cases: Iterable[str] = tuple(CASES),
    progress: Progress | None = None,
) -> RiskModel:
    """Flies, and fits; each case has the same weight, however many flights it has.

    Args:
        config: Of lander, lidar, and mapping.
        seeds: Dealt to the cases in turn, a flight each.
        cases: Names in ``CASES``.
        progress: Gets the flights that are done and those there are.

    Raises:
        EvaluationError: there is no such case, or no seed or no landing for one.
    """
    names = list(dict.fromkeys(cases))
    for name in names:
        if name not in CASES:
            msg = f"there is no case {name!r}; there are {', '.join(CASES)}"
            raise EvaluationError(msg)
    if len(seeds) < len(names) or not names:
        msg = f"{len(seeds)} seeds are too few for {len(names)} cases"
        raise EvaluationError(msg)
    flown: dict[str, list[Landings]] = {name: [] for name in names}
    of_seed: dict[str, list[int]] = {name: [] for name in names}
    for done, seed in enumerate(seeds):
        name = names[done % len(names)]
        terrain = hazard_field(np.random.default_rng([seed, 1]), FIELDS[CASES[name].field])
        maps = fly(terrain, seed, CASES[name], config, PARTS)
        own = CASES[name].mapping(config)
        flown[name] += [land(mapped, unfitted(), own) for mapped in maps]
        of_seed[name].append(seed)
        if progress is not None:
            progress(done + 1, len(seeds))
    for name, landings in flown.items():
        failed = sum(int(one.failed.sum()) for one in landings)
        if not failed or failed == sum(one.failed.size for one in landings):
            msg = f"case {name}: {'every' if failed else 'no'} landing fails: nothing to fit"
            raise EvaluationError(msg)
    model = fitted(flown, config)
    return replace(model, provenance=_provenance(model, flown, of_seed, config))


def fitted(flown: dict[str, list[Landings]], config: Config) -> RiskModel:
    """The model of landings, by case."""
    lss, model = config.lss, unfitted()
    slope0 = float(np.tan(np.radians(lss.max_slope_deg)))

    def first(one: Landings) -> Array:
        rise = one.worst.rise[one.counts] - lss.max_roughness
        return counted(
            rise, one.worst.slope[one.counts] - slope0, one.failed, (RISE_BINS, SLOPE_BINS)
        )

    rise_odds, slope_odds = fit_curves(np.asarray(sum(_evenly(flown, first))))
    usual = max(config.lidar.range_noise, 1e-6)
    noise = usual, NOISIER * usual
    model = replace(model, rise_odds=rise_odds, slope_odds=slope_odds, noise=noise)
    shares = [
        RiskTable(model, lss, one.noise).shares(one.worst, one.judged, one.slope)
        for landings in flown.values()
        for one in landings
    ]
    table = RiskTable(model, lss, usual)

    def second(one: Landings) -> Array:
        own, about = (odds[one.counts] for odds in table.log_odds(one.worst, one.judged))
        return counted(own, about, one.failed, (OWN_BINS, ABOUT_BINS))

    found = fit_tables(np.array(shares), np.array(list(_evenly(flown, second))))
    *tables, noisy = (tuple(rounded(line) for line in table) for table in found)
    kinds = len(model.rocks)
    odds, undulating = tuple(tables[:kinds]), tuple(tables[kinds:])
    return replace(model, odds=odds, undulating=undulating, noisy=noisy)


def _evenly(
    flown: dict[str, list[Landings]], count: Callable[[Landings], Array]
) -> Iterator[Array]:
    """Counts of each map; together those of a case have weight 1."""
    for landings in flown.values():
        weight = 1.0 / sum(one.failed.size for one in landings)
        for one in landings:
            yield weight * count(one)


def _provenance(
    model: RiskModel,
    flown: dict[str, list[Landings]],
    seeds: dict[str, list[int]],
    config: Config,
) -> dict[str, Any]:
    cases = {}
    for name, landings in flown.items():
        table = RiskTable(model, config.lss, landings[0].noise)
        risk = [table.risk(one.worst, one.judged, one.slope)[one.counts] for one in landings]
        failed = np.concatenate([one.failed for one in landings])
        brier, log = scores(np.concatenate(risk), failed)
        given = asdict(CASES[name])
        given["noise"] = round(given["noise"] * config.lidar.range_noise, 4)
        cases[name] = {
            **given,
            "seeds": seeds[name],
            "points": int(failed.size),
            "failed": round(float(failed.mean()), 4),
            "brier": round(brier, 5),
            "log_score": round(log, 5),
        }
    lander = lander_of(config)
    return {
        "package": f"quadtree_lss {quadtree_lss.__version__} ({build.name()})",
        "flights": sum(map(len, seeds.values())),
        "parts": list(PARTS),
        "lander": {
            "diameter": lander.diameter,
            "pad_radius": lander.pad_radius,
            "max_slope_deg": lander.max_slope_deg,
            "max_roughness": lander.max_roughness,
        },
        "finest_cell": config.domain.size / 2**config.domain.max_level,
        "range_noise": config.lidar.range_noise,
        "brier": round(float(np.mean([case["brier"] for case in cases.values()])), 5),
        "log_score": round(float(np.mean([case["log_score"] for case in cases.values()])), 5),
        "cases": cases,
    }
