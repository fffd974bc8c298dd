# SPDX-License-Identifier: Apache-2.0
"""Simulate flights in memory and fit the risk model to their maps.

Ground and views are made for a lander of 3.7 m and scaled to the vehicle. Ground, view, vehicle,
cells and noise of each flight are drawn from its family.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

import quadtree_lss
from quadtree_lss import build
from quadtree_lss.lab.evaluation import risk_families
from quadtree_lss.lab.evaluation.metrics import scores
from quadtree_lss.lab.evaluation.results import EvaluationError
from quadtree_lss.lab.evaluation.risk_families import FAMILIES, Family, Range, log_uniform
from quadtree_lss.lab.evaluation.risk_fit import fit, risks, unfitted
from quadtree_lss.lab.simulation.safety import LandingGear, on_dem, worst_contact
from quadtree_lss.lab.simulation.terrain import Terrain
from quadtree_lss.lab.simulation.trajectory import DriftingNavigation
from quadtree_lss.onboard.arrays import Array, Mask, Single
from quadtree_lss.onboard.config.risk import OVERALL, RiskModel
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.contact import ContactCheck
from quadtree_lss.onboard.core.landing.raster import rasterise
from quadtree_lss.onboard.core.landing.risk import RiskTable, contact_limits
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.messages.maps import round_trip

#: Ranges of the fractions of a flight after which its map is used.
PARTS: tuple[Range, ...] = ((0.05, 0.33), (0.33, 0.8), (1.0, 1.0))
#: Largest number of landings of one map in a fit.
MAX_LANDINGS = 500


@dataclass(frozen=True)
class Mapped:
    """A map after a fraction ``part`` of a flight, and slope (tangent) and rise (m) of the worst
    true contact at the corners of its finest cells, (n + 1, n + 1); NaN if unknown."""

    config: Config
    part: float
    cells: CellMap
    slope: Single
    rise: Single

    @property
    def known(self) -> Mask:
        return ~np.isnan(self.rise)

    @property
    def safe(self) -> Mask:
        vehicle = self.config.vehicle
        stands = self.slope <= np.tan(np.radians(vehicle.max_slope_deg))
        return np.asarray(stands & (self.rise <= vehicle.clearance))


def fly(family: Family, seed: int, config: Config, terrain: Terrain | None = None) -> list[Mapped]:
    """Simulate and map a flight; return the maps after each of `PARTS`. ``config`` has the values
    that the family does not vary; ``terrain`` is for a lander of 3.7 m, None to draw one."""
    rng = np.random.default_rng([seed, 77])
    own, noise, outliers = _draw_case(rng, family, config)
    scale = own.vehicle.diameter / risk_families.REFERENCE_DIAMETER
    if terrain is None:
        terrain = risk_families.ground(rng, str(rng.choice(family.grounds)))
    surface = terrain.scaled(scale)
    name = str(rng.choice(family.views))
    view = risk_families.VIEWS[name](rng)
    # Wide lidars are combined with a less accurate attitude.
    error, turn = scale * log_uniform(rng, 0.3, 1.5), 1.0 if name in ("morpheus", "sweep") else 3.0
    navigation = DriftingNavigation(0.03 * error, 0.01 * error, 0.01 * turn, 0.0015 * turn)
    positions = scale * view.positions
    estimate = navigation.estimate(rng, view.times, positions, view.rotations)
    parts = [log_uniform(rng, *part) for part in PARTS]
    marks = {max(2, round(part * len(view.times))): part for part in parts}
    cover = risk_families.Cover.draw(rng, family, own.vehicle.clearance, scale)
    mapper, found, beams = Mapper(own), [], view.beams.reshape(-1, 3)
    for k, time in enumerate(view.times):
        directions = beams @ view.rotations[k].T
        ranges = surface.cast(positions[k], directions)
        cover.apply(rng, positions[k], directions, ranges)
        ranges += rng.normal(0.0, noise, ranges.shape)
        wrong = rng.random(ranges.shape) < outliers
        ranges[wrong] += 10.0 * scale * rng.uniform(-1.0, 1.0, int(wrong.sum()))
        ranges[~(ranges > 0.0)] = np.nan
        points = (ranges[:, None] * beams).astype(np.float32).reshape(view.beams.shape)
        found_pose = estimate.positions[k], estimate.rotations[k], estimate.covariance
        mapper.update(points, Pose(round(1e9 * (1000.0 + time)), *found_pose))
        if k + 1 in marks:
            found.append((marks[k + 1], round_trip(mapper.snapshot())))
    domain, lander = mapper.domain, lander_of(own)
    along = domain.finest_size * np.arange(domain.finest_count + 1)
    corners = np.stack(np.meshgrid(domain.xmin + along, domain.ymin + along), axis=-1)
    known = on_dem(surface, corners, lander)
    contact = np.full((2, *known.shape), np.nan, dtype=np.float32)
    contact[:, known] = worst_contact(surface, corners[known], lander)
    return [Mapped(own, part, cells, *contact) for part, cells in found]


def _draw_case(
    rng: np.random.Generator, family: Family, config: Config
) -> tuple[Config, float, float]:
    """Draw configuration, true range noise, m, and fraction of outliers of a flight."""

    def between(ends: Range | None, default: float) -> float:
        return default if ends is None else log_uniform(rng, *ends)

    default = config.vehicle
    diameter = between(family.diameter, default.diameter)
    clearance = diameter * between(family.clearance, default.clearance / default.diameter)
    slope = default.max_slope_deg if family.slopes is None else float(rng.choice(family.slopes))
    pad = default.pad_radius * diameter / default.diameter
    sizes = {"diameter": diameter, "clearance": clearance, "pad_radius": pad}
    vehicle = replace(default, max_slope_deg=slope, **sizes)
    noise = clearance * between(family.noise, config.lidar.range_noise / default.clearance)
    domain = config.domain
    cells = default.diameter / (domain.size / 2**domain.max_level)
    side = diameter / between(family.cells, cells)
    level = int(np.log2(64.1 / risk_families.REFERENCE_DIAMETER * diameter / side))
    size = side * 2**level
    above = int(rng.integers(3, 5)) if family.cells else domain.max_level - domain.min_level
    levels = {"min_level": max(level - above, 0), "max_level": level}
    own = replace(domain, xmin=-0.5 * size, ymin=-0.5 * size, size=size, **levels)
    configured_noise = max(noise * float(rng.choice(family.noise_factors)), 1e-4)
    lidar = replace(config.lidar, range_noise=configured_noise)
    lss = replace(config.lss, grid_spacing=side)
    made = replace(config, vehicle=vehicle, domain=own, lidar=lidar, lss=lss)
    return made, noise, float(rng.choice(family.outliers))


def lander_of(config: Config) -> LandingGear:
    """Landing gear by the parameters ``vehicle.*``."""
    of = config.vehicle
    return LandingGear(of.diameter, of.pad_radius, of.max_slope_deg, max_roughness=of.clearance)


@dataclass(frozen=True)
class Landings:
    """Landings at the ``usable`` (n + 1, n + 1) grid points of a map, where all ground under the
    lander is observed and the truth is known: features (K, len(FEATURES)), predicted risk (K,), and
    whether they fail (K,)."""

    usable: Mask
    features: Single
    risk: Array
    failed: Mask


def land(mapped: Mapped, model: RiskModel) -> Landings:
    """Compute contact and risk at each grid point with a model."""
    lss = mapped.config.lss
    raster = rasterise(mapped.cells, lss)
    contacts = ContactCheck(lss, contact_limits(model, lss)).contacts(raster, raster.needs_contact)
    usable = raster.assessable & mapped.known
    table = RiskTable(model, lss, mapped.config.lidar.range_noise)
    local = table.features(raster, contacts)[:, usable].T
    overall = table.overall(raster.domain.finest_size)
    all_over = np.tile([overall[name] for name in OVERALL], (len(local), 1))
    features = np.hstack([local, all_over]).astype(np.float32)
    risk = table.risk(raster, contacts)[0][usable]
    return Landings(usable, features, risk, ~mapped.safe[usable])


class Sample(NamedTuple):
    """Landings of a map: features (K, len(FEATURES)), failures (K,) and weights (K,)."""

    features: Single
    failed: Mask
    weight: Array


def sampled(rng: np.random.Generator, mapped: Mapped) -> Sample:
    """Sample landings of a map, with few certain and many unexpected failures."""
    landings = land(mapped, unfitted())
    features, failed = landings.features, landings.failed
    share = np.full(failed.size, min(1.0, MAX_LANDINGS / max(failed.size, 1)))
    rise, rise_beside, tilt, tilt_beside = features[:, :4].T
    share[(rise > 1.45) | (tilt > 1.14)] *= 0.25
    unseen = failed & (rise_beside < 1.0) & (tilt_beside < 1.0)
    share[unseen] = np.minimum(8.0 * share[unseen], 1.0)
    some = rng.random(failed.size) < share
    return Sample(features[some], failed[some], 1.0 / share[some])


def fit_risk(
    config: Config,
    seeds: Sequence[int],
    families: Iterable[str] = tuple(FAMILIES),
    progress: Callable[[int, int], None] | None = None,
) -> RiskModel:
    """Simulate flights and fit a model. The seeds are assigned to the families in turn. Raises
    `EvaluationError`: a family is unknown or has no seed or no failure."""
    names = list(dict.fromkeys(families))
    for name in names:
        if name not in FAMILIES:
            raise EvaluationError(f"there is no family {name!r}; there are {', '.join(FAMILIES)}")
    if len(seeds) < len(names) or not names:
        raise EvaluationError(f"{len(seeds)} seeds are too few for {len(names)} families")
    samples_by_family: dict[str, list[Sample]] = {name: [] for name in names}
    for done, seed in enumerate(seeds):
        name, rng = names[done % len(names)], np.random.default_rng([seed, 78])
        maps = fly(FAMILIES[name], seed, config)
        samples_by_family[name] += [sampled(rng, mapped) for mapped in maps]
        if progress is not None:
            progress(done + 1, len(seeds))
    seeds_by_family = {name: list(seeds[k :: len(names)]) for k, name in enumerate(names)}
    return fitted(samples_by_family, seeds_by_family, config)


def fitted(
    samples_by_family: dict[str, list[Sample]], seeds: dict[str, list[int]], config: Config
) -> RiskModel:
    """Fit a model to the landings of each family; ``seeds`` are those of its flights."""
    parts, weights = [], []
    for name, samples in samples_by_family.items():
        one = Sample(*map(np.concatenate, zip(*samples, strict=True)))
        if one.failed.all() or not one.failed.any():
            which = "every" if one.failed.any() else "no"
            raise EvaluationError(f"family {name}: {which} landing fails: nothing to fit")
        parts.append(one)
        weights.append(FAMILIES[name].weight * one.weight / one.weight.sum())
    features, failed, _ = map(np.concatenate, zip(*parts, strict=True))
    model = fit(features, failed, np.concatenate(weights))
    families = {}
    for name, one in zip(samples_by_family, parts, strict=True):
        risk = risks(model, one.features)
        brier, log = scores(risk, one.failed, one.weight)
        families[name] = {
            "seeds": seeds[name],
            "points": int(one.weight.sum()),
            "failed": round(float(np.average(one.failed, weights=one.weight)), 4),
            "brier": round(brier, 5),
            "log_score": round(log, 5),
        }
    overall = features[:, -len(OVERALL) :].T
    return replace(model, provenance=_provenance(families, overall, config))


def _provenance(
    families: dict[str, dict[str, Any]], overall: Array, config: Config
) -> dict[str, Any]:
    noise, cell, clearance, _ = overall
    of = [FAMILIES[name] for name in families]

    def span(name: str, default: float) -> list[float]:
        ends = [getattr(family, name) or (default,) for family in of]
        return [min(min(end) for end in ends), max(max(end) for end in ends)]

    def ends(values: Array) -> list[float]:
        return [round(float(10.0**end), 4) for end in (values.min(), values.max())]

    return {
        "package": f"quadtree_lss {quadtree_lss.__version__} ({build.name()})",
        "flights": sum(len(one["seeds"]) for one in families.values()),
        "fitted": {
            "diameter": span("diameter", config.vehicle.diameter),
            "clearance": ends(clearance),
            "max_slope_deg": span("slopes", config.vehicle.max_slope_deg),
            "cell": ends(cell + clearance),
            "noise": ends(noise),
        },
        "families": families,
    }
