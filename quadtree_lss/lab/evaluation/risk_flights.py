# SPDX-License-Identifier: Apache-2.0
"""Flies over simulated ground, in memory, and fits what a map tells of a safe touchdown.

All is flown over ground made for a lander of 3.7 m and scaled to the vehicle, seen from views that
are scaled alike. Families differ in ground, view, vehicle, cells and noise; each flight draws its
own of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter

import quadtree_lss
from quadtree_lss import build
from quadtree_lss.lab.evaluation.metrics import scores
from quadtree_lss.lab.evaluation.results import EvaluationError
from quadtree_lss.lab.evaluation.risk_fit import fit, risks, unfitted
from quadtree_lss.lab.simulation.hazard_field import FIELDS, HazardField, hazard_field
from quadtree_lss.lab.simulation.lidar import pixel_beams
from quadtree_lss.lab.simulation.navigation import DriftingNavigation
from quadtree_lss.lab.simulation.safety import LandingGear, on_dem, worst_contact
from quadtree_lss.lab.simulation.terrain import Terrain
from quadtree_lss.lab.simulation.trajectory import NORTH, Sweep, look_at
from quadtree_lss.onboard.arrays import Array, Index, Mask, Single
from quadtree_lss.onboard.config.risk import OVERALL, RiskModel
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.probability import RiskTable, limits
from quadtree_lss.onboard.core.landing.raster import TerrainRaster, rasterise
from quadtree_lss.onboard.core.landing.score import Surroundings, look_around
from quadtree_lss.onboard.core.landing.touchdown import TouchdownCheck, WorstContact
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.messages.maps import round_trip

Range = tuple[float, float]
#: The lander that grounds and views are made for, m; half the side of what it looks at.
LANDER, HALF = 3.7, 30.0
#: A flight is judged after a part between these, and at its end.
PARTS: tuple[Range, ...] = ((0.05, 0.33), (0.33, 0.8), (1.0, 1.0))
#: Landings of a map that a fit takes at most.
TAKEN = 500
#: Side of the tiles, diameters, whose failures are taken for independent.
TILE = 2.2


@dataclass(frozen=True)
class Family:
    """What flights of a kind draw from; None is as the configuration has it.

    Attributes:
        grounds: Names in `FIELDS`, or ``any``, ``mixed`` or ``bare``.
        views: Names in `VIEWS`.
        diameter: Of the vehicle, m; clearance: over it; slopes: that it stands on, deg.
        cells: Along the diameter.
        noise: Of a range over the clearance; told: times that the mapping is told.
        outliers: Shares of false returns.
        weight: In a fit, beside others.
    """

    grounds: tuple[str, ...] = tuple(FIELDS)
    views: tuple[str, ...] = ("morpheus",)
    diameter: Range | None = None
    clearance: Range | None = None
    slopes: tuple[float, ...] | None = None
    cells: Range | None = None
    noise: Range | None = None
    told: tuple[float, ...] = (1.0,)
    outliers: tuple[float, ...] = (0.0,)
    weight: float = 1.0


_ANY = (*FIELDS, "any")
_SIZES: dict[str, Any] = {
    "diameter": (0.5, 8.0),
    "clearance": (0.055, 0.17),
    "slopes": (6.0, 8.0, 10.0, 12.0, 15.0),
    "cells": (5.0, 16.0),
}
FAMILIES: dict[str, Family] = {
    "whole": Family(weight=2.0),
    "thin": Family(views=("oblique",), weight=1.5),
    "mixed": Family(grounds=("mixed",), views=("morpheus", "sweep"), weight=1.5),
    "bare": Family(grounds=("bare",), views=("morpheus", "sweep", "descent")),
    "noise": Family(
        views=("sweep",),
        noise=(0.1, 0.3),
        told=(1.0, 0.75, 1.3),
        outliers=(0.0, 0.02),
        weight=1.5,
    ),
    "few": Family(grounds=(*_ANY, "mixed"), views=("few",), weight=0.7),
    "views": Family(grounds=_ANY, views=("sweep", "descent", "wide"), weight=0.7),
    "drone": Family(
        grounds=(*_ANY, "mixed", "bare"),
        views=("wide",),
        diameter=(0.5, 0.8),
        clearance=(0.09, 0.17),
        cells=(4.8, 12.0),
        noise=(0.2, 0.35),
    ),
    "large": Family(
        grounds=_ANY,
        views=("sweep", "descent"),
        diameter=(5.0, 8.0),
        clearance=(0.055, 0.1),
        cells=(5.0, 16.0),
        noise=(0.07, 0.25),
    ),
    "vehicles": Family(
        grounds=_ANY, views=("sweep", "descent", "morpheus"), noise=(0.07, 0.35), **_SIZES
    ),
    "any": Family(
        grounds=(*_ANY, "mixed", "bare"),
        views=("sweep", "descent", "oblique", "wide", "few"),
        noise=(0.07, 0.4),
        told=(1.0, 1.0, 0.8, 1.25),
        outliers=(0.0, 0.0, 0.01),
        weight=0.7,
        **_SIZES,
    ),
}


def ground(rng: np.random.Generator, kind: str) -> Terrain:
    """80 x 80 m of one of `FIELDS`; or of ``any`` such field, ``plain``, ``cratered``, ``bare`` (an
    incline), or ``mixed``: two of them, half and half or in patches."""
    if kind == "mixed":
        one, two = rng.choice(_PAIRS)
        first, second = ground(rng, one), ground(rng, two)
        x, y = np.meshgrid(first.x, first.y)
        if rng.random() < 0.6:
            heading = rng.uniform(0.0, 2.0 * np.pi)
            across = x * np.cos(heading) + y * np.sin(heading) + rng.uniform(-6.0, 6.0)
        else:
            across = gaussian_filter(rng.standard_normal(x.shape), rng.uniform(33.0, 60.0))
            across *= 4.0 / across.std()
        share = 1.0 / (1.0 + np.exp(-across / rng.uniform(0.2, 1.0)))
        z = share * first.elevation + (1.0 - share) * second.elevation
        return Terrain(first.x, first.y, z)
    field = FIELDS.get(kind, HazardField(rock_abundance=0.0, piles=0.0))
    if kind == "any":
        rocks = rng.uniform(0.005, 0.12) if rng.random() < 0.8 else 0.0
        field = HazardField(
            rock_abundance=rocks,
            piles=rng.uniform(0.0, 8e-3) * (rocks > 0.0),
            craters=rng.uniform(0.0, 15e-3),
            slope_rms_deg=rng.uniform(0.3, 6.5),
            texture=rng.uniform(0.003, 0.025),
        )
    elif kind == "cratered":
        craters, depth = rng.uniform(12e-3, 30e-3), rng.uniform(0.08, 0.18)
        field = replace(field, craters=craters, crater_depth=depth)
    elif kind not in FIELDS:
        craters = rng.choice([0.0, 6e-3]) if kind == "bare" else 0.0
        rocks = rng.choice([0.0, 0.005, 0.02], p=[0.6, 0.2, 0.2]) if kind == "bare" else 0.0
        slope, texture = rng.uniform(0.3, 3.0), rng.uniform(3e-3, 0.015)
        field = replace(field, craters=craters, rock_abundance=rocks)
        field = replace(field, slope_rms_deg=slope, texture=texture)
    made = hazard_field(rng, replace(field, size=80.0))
    if kind != "bare":
        return made
    rise, heading = np.tan(np.radians(rng.uniform(3.0, 9.5))), rng.uniform(0.0, 2.0 * np.pi)
    east, north = rise * np.cos(heading), rise * np.sin(heading)
    return Terrain(made.x, made.y, made.elevation + east * made.x + north * made.y[:, None])


_PAIRS = (
    ("rocky", "bare"),
    ("any", "any"),
    ("cratered", "plain"),
    ("rocky", "smooth"),
    ("rough", "plain"),
    ("default", "cratered"),
)


@dataclass(frozen=True)
class View:
    """Scans of a lander of 3.7 m: their times (S,), s, true poses (S, 3), (S, 3, 3), and beams."""

    times: Array
    positions: Array
    rotations: Array
    beams: Array


def _even(rng: np.random.Generator, low: float, high: float) -> float:
    """Drawn evenly in the logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _morpheus(rng: np.random.Generator) -> View:
    """Section VII: 20 s at 20 Hz from 450 m on a glide slope of 30 deg."""
    return _swept(Sweep((0.0, 0.0, 0.0), HALF, HALF, 20.0, 1.0), 20.0, 128)


def _sweep(rng: np.random.Generator) -> View:
    """Such a sweep from nearer and steeper, with fewer scans."""
    duration, slant = rng.uniform(5.0, 25.0), rng.uniform(120.0, 450.0)
    sweep = Sweep(
        (0.0, 0.0, 0.0),
        HALF,
        HALF,
        duration,
        _even(rng, 1.0, 5.0),
        slant_range=slant,
        glide_slope_deg=rng.uniform(25.0, 80.0),
        approach_speed=rng.uniform(1.0, 0.4 * slant / duration),
        reverse=rng.random() < 0.5,
    )
    return _swept(sweep, _even(rng, 2.0, 20.0), int(rng.choice([48, 64, 96, 128])))


def _oblique(rng: np.random.Generator) -> View:
    """A fast approach from about 180 m at about 55 deg that misses much of the ground."""
    duration, slant = rng.uniform(8.0, 16.0), rng.uniform(140.0, 220.0)
    half = HALF * rng.uniform(0.5, 1.0)
    sweep = Sweep(
        (rng.uniform(-10.0, 10.0), rng.uniform(-10.0, 10.0), 0.0),
        half,
        half,
        duration,
        float(rng.integers(1, 4)),
        slant_range=slant,
        glide_slope_deg=rng.uniform(45.0, 65.0),
        approach_speed=0.4 * slant / duration,
        overlap=float(rng.choice([-0.6, -0.3, 0.0, 0.2])),
        reverse=rng.random() < 0.5,
    )
    return _swept(sweep, _even(rng, 2.0, 20.0), int(rng.choice([48, 64, 96, 128])))


def _swept(sweep: Sweep, rate: float, pixels: int) -> View:
    times = np.arange(0.05 / rate, sweep.duration, 1.0 / rate)
    fov = sweep.field_of_view_deg
    return View(times, *sweep.trajectory().poses(times), pixel_beams(fov, fov, pixels, pixels))


def _descent(rng: np.random.Generator) -> View:
    """Down to a place near the middle that it looks at."""
    high, fov, pixels = rng.uniform(90.0, 250.0), rng.uniform(8.0, 35.0), rng.choice([48, 64, 128])
    begin = np.array([*rng.uniform(-45.0, 45.0, 2), high])
    end = np.array([*rng.uniform(-12.0, 12.0, 2), high * rng.uniform(0.15, 0.8)])
    times, at = _passed(rng, begin, end)
    aims = np.tile([*rng.uniform(-10.0, 10.0, 2), 0.0], (len(times), 1))
    beams = pixel_beams(fov, fov, int(pixels), int(pixels))
    return View(times, at, look_at(at, aims, NORTH), beams)


def _wide(rng: np.random.Generator, rate: float | None = None) -> View:
    """Over the ground, looking down with a wide or a spinning lidar; at a rate, Hz, or any."""
    high = rng.uniform(90.0, 190.0)
    begin = np.array([*rng.uniform(-45.0, 45.0, 2), high])
    end = np.array([*(-begin[:2] * rng.uniform(0.2, 1.0)), high * rng.uniform(0.5, 1.0)])
    times, at = _passed(rng, begin, end, rate)
    aims = np.column_stack([at[:, :2] + rng.uniform(-0.2, 0.2, 2) * high, np.zeros(len(at))])
    lines = int(rng.choice([16, 32, 64])) if rng.random() < 0.6 else 0
    pixels, fov = int(rng.choice([64, 96, 128])), rng.uniform(40.0, 80.0)
    shape = (int(rng.choice([256, 512])), lines) if lines else (pixels, pixels)
    down = rng.uniform(22.0, 60.0) if lines else fov
    return View(times, at, look_at(at, aims, NORTH), pixel_beams(fov, down, *shape))


def _few(rng: np.random.Generator) -> View:
    """So few scans that a clearance wide has 0.3 to 40 returns."""
    fov, high = rng.uniform(12.0, 40.0), rng.uniform(80.0, 220.0)
    tilt = np.radians(rng.uniform(0.0, 60.0)) * (rng.random() < 0.5)
    rows, columns = int(rng.choice([16, 32, 48, 64, 128])), int(rng.choice([32, 64, 128]))
    area = (2.0 * high * np.tan(np.radians(0.5 * fov))) ** 2 / np.cos(tilt)
    count = int(np.clip(_even(rng, 0.3, 40.0) * area / (0.09 * rows * columns), 4, 200))
    times = np.sort(rng.uniform(0.0, rng.uniform(5.0, 20.0), count))
    heading = rng.uniform(0.0, 2.0 * np.pi)
    ahead = np.array([np.cos(heading), np.sin(heading)])
    height = high * np.linspace(1.0, rng.uniform(0.55, 1.0), count)[:, None]
    along = rng.uniform(-15.0, 15.0) * np.linspace(-0.5, 0.5, count)[:, None]
    aims = rng.uniform(-8.0, 8.0, 2) + along * [-ahead[1], ahead[0]]
    aims += rng.normal(0.0, 1.5, (count, 2))
    at = np.hstack([aims - np.tan(tilt) * height * ahead, height])
    aims = np.column_stack([aims, np.zeros(count)])
    return View(times, at, look_at(at, aims, NORTH), pixel_beams(fov, fov, columns, rows))


def _passed(
    rng: np.random.Generator, begin: Array, end: Array, rate: float | None = None
) -> tuple[Array, Array]:
    """Times, of a rate or 12 to 119 at random, and places between two."""
    duration = rng.uniform(8.0, 40.0)
    count = int(rng.integers(12, 120))
    times = np.sort(rng.uniform(0.0, duration, count))
    times = times if rate is None else np.arange(0.0, duration, 1.0 / rate)
    share = (times / duration)[:, None]
    return times, begin + (end - begin) * share * (1.25 - 0.25 * share)


VIEWS: dict[str, Callable[[np.random.Generator], View]] = {
    "morpheus": _morpheus,
    "sweep": _sweep,
    "oblique": _oblique,
    "descent": _descent,
    "wide": _wide,
    "scanning": partial(_wide, rate=10.0),
    "few": _few,
}


@dataclass(frozen=True)
class Mapped:
    """A map at a time of a flight, and what was true at the grid points of its finest lattice.

    Attributes:
        config: It was mapped with.
        part: Of the flight.
        cells: The map, as its message gives it.
        slope, rise: (n + 1, n + 1) of the worst true contact, over run and m; NaN if not known.
    """

    config: Config
    part: float
    cells: CellMap
    slope: Single
    rise: Single

    @property
    def known(self) -> Mask:
        """(n + 1, n + 1) grid points whose truth is known."""
        return ~np.isnan(self.rise)

    @property
    def safe(self) -> Mask:
        """(n + 1, n + 1) of them, where the lander stands safely."""
        vehicle = self.config.vehicle
        stands = self.slope <= np.tan(np.radians(vehicle.max_slope_deg))
        return np.asarray(stands & (self.rise <= vehicle.clearance))


def fly(family: Family, seed: int, config: Config, terrain: Terrain | None = None) -> list[Mapped]:
    """A simulated flight, mapped, after each of `PARTS` of it.

    Args:
        family: What it draws from.
        seed: Of all that is drawn.
        config: Vehicle, noise and cells of families that vary none; and how to map.
        terrain: At the scale of `LANDER`; None for one of the family.
    """
    rng = np.random.default_rng([seed, 77])
    own, noise, outliers = _drawn(rng, family, config)
    vehicle = own.vehicle
    scale = vehicle.diameter / LANDER
    made = ground(rng, str(rng.choice(family.grounds))) if terrain is None else terrain
    surface = Terrain(scale * made.x, scale * made.y, scale * made.elevation)
    name = str(rng.choice(family.views))
    view = VIEWS[name](rng)
    # An attitude is as good as the lidar needs it.
    error, turn = scale * _even(rng, 0.3, 1.5), 1.0 if name in ("morpheus", "sweep") else 3.0
    navigation = DriftingNavigation(0.03 * error, 0.01 * error, 0.01 * turn, 0.0015 * turn)
    positions = scale * view.positions
    told = navigation.estimate(rng, view.times, positions, view.rotations)
    parts = [_even(rng, *part) for part in PARTS]
    marks = {max(2, round(part * len(view.times))): part for part in parts}
    mapper, found, beams = Mapper(own), [], view.beams.reshape(-1, 3)
    for k, time in enumerate(view.times):
        ranges = surface.cast(positions[k], beams @ view.rotations[k].T)
        ranges += rng.normal(0.0, noise, ranges.shape)
        wrong = rng.random(ranges.shape) < outliers
        ranges[wrong] += 10.0 * scale * rng.uniform(-1.0, 1.0, int(wrong.sum()))
        ranges[~(ranges > 0.0)] = np.nan
        points = (ranges[:, None] * beams).astype(np.float32).reshape(view.beams.shape)
        stamp = round(1e9 * (1000.0 + time))
        mapper.update(points, Pose(stamp, told.positions[k], told.rotations[k], told.covariance))
        if k + 1 in marks:
            found.append((marks[k + 1], round_trip(mapper.snapshot())))
    slope, rise = _truth(found[-1][1], surface, own)
    return [Mapped(own, part, cells, slope, rise) for part, cells in found]


def _drawn(rng: np.random.Generator, family: Family, config: Config) -> tuple[Config, float, float]:
    """The configuration of a flight, the true noise of its ranges, m, and the share of outliers."""

    def between(ends: Range | None, usual: float) -> float:
        return usual if ends is None else _even(rng, *ends)

    usual = config.vehicle
    diameter = between(family.diameter, usual.diameter)
    clearance = diameter * between(family.clearance, usual.clearance / usual.diameter)
    slope = usual.max_slope_deg if family.slopes is None else float(rng.choice(family.slopes))
    pad = usual.pad_radius * diameter / usual.diameter
    vehicle = replace(
        usual, diameter=diameter, clearance=clearance, max_slope_deg=slope, pad_radius=pad
    )
    noise = clearance * between(family.noise, config.lidar.range_noise / usual.clearance)
    domain = config.domain
    cells = usual.diameter / (domain.size / 2**domain.max_level)
    side = diameter / between(family.cells, cells)
    level = int(np.log2(64.1 / LANDER * diameter / side))
    size = side * 2**level
    above = int(rng.integers(3, 5)) if family.cells else domain.max_level - domain.min_level
    own = replace(
        domain,
        xmin=-0.5 * size,
        ymin=-0.5 * size,
        size=size,
        min_level=max(level - above, 0),
        max_level=level,
    )
    gate = config.lidar.outlier_gate * diameter / usual.diameter
    told = max(noise * float(rng.choice(family.told)), 1e-4)
    lidar = replace(config.lidar, range_noise=told, outlier_gate=gate)
    lss = replace(config.lss, grid_spacing=side)
    made = replace(config, vehicle=vehicle, domain=own, lidar=lidar, lss=lss)
    return made, noise, float(rng.choice(family.outliers))


def _truth(cells: CellMap, surface: Terrain, config: Config) -> tuple[Single, Single]:
    """Slopes and rises of the worst true contacts, NaN off the terrain."""
    domain, lander = cells.domain, lander_of(config)
    along = domain.finest_size * np.arange(domain.finest_count + 1)
    points = np.stack(np.meshgrid(domain.xmin + along, domain.ymin + along), axis=-1)
    known = on_dem(surface.x, surface.y, points.reshape(-1, 2), lander).reshape(points.shape[:2])
    out = np.full((2, *known.shape), np.nan, dtype=np.float32)
    out[:, known] = worst_contact(surface.x, surface.y, surface.elevation, points[known], lander)
    return out[0], out[1]


def lander_of(config: Config) -> LandingGear:
    """The vehicle that the parameters describe: whose safety is judged, and is true."""
    of = config.vehicle
    return LandingGear(of.diameter, of.pad_radius, of.max_slope_deg, max_roughness=of.clearance)


@dataclass(frozen=True)
class Landings:
    """Landings at the grid points of a map.

    Attributes:
        raster, around, worst: The map, what lies about its points, and contacts there.
        counts: (n + 1, n + 1) where all ground under the lander is seen and the truth is known.
        failed: (K,) of these: whether the lander fails there.
    """

    raster: TerrainRaster
    around: Surroundings
    worst: WorstContact
    counts: Mask
    failed: Mask

    def risk(self, table: RiskTable) -> Array:
        """(K,) P(unsafe)."""
        gradient = self.around.planes.gradient
        return table.risk(self.raster, self.around.judged, gradient, self.worst)[0][self.counts]

    def asked(self, table: RiskTable) -> Single:
        """(K, len(ASKED)) what a model asks of each place."""
        gradient = self.around.planes.gradient
        of = table.features(self.raster, self.around.judged, gradient, self.worst)[:, self.counts].T
        overall = table.overall(self.raster.domain.finest_size)
        all_over = np.tile([overall[name] for name in OVERALL], (len(of), 1))
        return np.hstack([of, all_over]).astype(np.float32)

    def tiles(self, diameter: float) -> Index:
        """(K,) number of the tile of the ground that each lies in."""
        side = max(1, round(TILE * diameter / self.raster.domain.finest_size))
        row, column = np.argwhere(self.counts).T // side
        return np.asarray(10_000 * row + column)


def land(mapped: Mapped, model: RiskModel) -> Landings:
    """Sets the lander down on a map at every grid point, with the limits of a model."""
    lss = mapped.config.lss
    raster = rasterise(mapped.cells, lss)
    around = look_around(raster, lss)
    worst = TouchdownCheck(lss, limits(model, lss)).worst(raster, around.met)
    counts = around.judged & mapped.known
    return Landings(raster, around, worst, counts, ~mapped.safe[counts])


def table_of(model: RiskModel, config: Config) -> RiskTable:
    """A model for the vehicle and the noise of a configuration."""
    return RiskTable(model, config.lss, config.lidar.range_noise)


class Sample(NamedTuple):
    """Some landings of a map: what was asked (K, len(ASKED)), whether they failed (K,), and how
    many each stands for (K,)."""

    asked: Single
    failed: Mask
    weight: Array


def sampled(rng: np.random.Generator, mapped: Mapped) -> Sample:
    """Some of a map's landings: of those that are sure to fail fewer, and of those that fail where
    nothing is to be seen more."""
    model = unfitted()
    landings = land(mapped, model)
    asked, failed = landings.asked(table_of(model, mapped.config)), landings.failed
    share = np.full(failed.size, min(1.0, TAKEN / max(failed.size, 1)))
    rise, rise_beside, tilt, tilt_beside = asked[:, :4].T
    share[(rise > 1.45) | (tilt > 1.14)] *= 0.25
    unseen = failed & (rise_beside < 1.0) & (tilt_beside < 1.0)
    share[unseen] = np.minimum(8.0 * share[unseen], 1.0)
    some = rng.random(failed.size) < share
    return Sample(asked[some], failed[some], 1.0 / share[some])


Progress = Callable[[int, int], None]


def fit_risk(
    config: Config,
    seeds: Sequence[int],
    families: Iterable[str] = tuple(FAMILIES),
    progress: Progress | None = None,
) -> RiskModel:
    """Flies, and fits; each family has its weight, however many flights it has.

    Args:
        config: Vehicle, noise and cells of families that vary none.
        seeds: Dealt to the families in turn, a flight each.
        families: Names in `FAMILIES`.
        progress: Gets the flights that are done and those there are.

    Raises:
        EvaluationError: there is no such family, or no seed or no landing for one.
    """
    names = list(dict.fromkeys(families))
    for name in names:
        if name not in FAMILIES:
            raise EvaluationError(f"there is no family {name!r}; there are {', '.join(FAMILIES)}")
    if len(seeds) < len(names) or not names:
        raise EvaluationError(f"{len(seeds)} seeds are too few for {len(names)} families")
    flown: dict[str, list[Sample]] = {name: [] for name in names}
    flights: dict[str, list[int]] = {name: [] for name in names}
    for done, seed in enumerate(seeds):
        name, rng = names[done % len(names)], np.random.default_rng([seed, 78])
        flown[name] += [sampled(rng, mapped) for mapped in fly(FAMILIES[name], seed, config)]
        flights[name].append(seed)
        if progress is not None:
            progress(done + 1, len(seeds))
    return fitted(flown, flights, config)


def fitted(
    flown: dict[str, list[Sample]], seeds: dict[str, list[int]], config: Config
) -> RiskModel:
    """The model of landings, by family, of flights by such seeds."""
    parts, weights = [], []
    for name, samples in flown.items():
        one = Sample(*map(np.concatenate, zip(*samples, strict=True)))
        if one.failed.all() or not one.failed.any():
            msg = f"family {name}: {'every' if one.failed.any() else 'no'} landing fails"
            raise EvaluationError(f"{msg}: nothing to fit")
        parts.append(one)
        weights.append(FAMILIES[name].weight * one.weight / one.weight.sum())
    asked, failed, _ = map(np.concatenate, zip(*parts, strict=True))
    model = fit(asked, failed, np.concatenate(weights))
    families = {}
    for name, one in zip(flown, parts, strict=True):
        risk = risks(model, one.asked)
        brier, log = scores(risk, one.failed, one.weight)
        families[name] = {
            "seeds": seeds[name],
            "points": int(one.weight.sum()),
            "failed": round(float(np.average(one.failed, weights=one.weight)), 4),
            "brier": round(brier, 5),
            "log_score": round(log, 5),
        }
    overall = asked[:, -len(OVERALL) :].T
    return replace(model, provenance=_provenance(families, overall, config))


def _provenance(
    families: dict[str, dict[str, Any]], overall: Array, config: Config
) -> dict[str, Any]:
    noise, cell, clearance = overall
    of = [FAMILIES[name] for name in families]

    def span(name: str, usual: float) -> list[float]:
        ends = [getattr(family, name) or (usual,) for family in of]
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
