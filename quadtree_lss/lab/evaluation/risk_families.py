# SPDX-License-Identifier: Apache-2.0
"""Families of grounds and views for simulated flights of a lander of 3.7 m."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from quadtree_lss.lab.simulation.hazard_field import FIELDS, HazardField, hazard_field
from quadtree_lss.lab.simulation.lidar import pixel_beams
from quadtree_lss.lab.simulation.terrain import Terrain
from quadtree_lss.lab.simulation.trajectory import NORTH, Sweep, look_at
from quadtree_lss.onboard.arrays import Array

Range = tuple[float, float]
#: Diameter of the lander that grounds and views are made for; half side of the viewed square, m.
REFERENCE_DIAMETER, HALF_SIDE = 3.7, 30.0


@dataclass(frozen=True)
class Family:
    """Ranges and choices of a family; None takes the configuration's value."""

    grounds: tuple[str, ...] = tuple(FIELDS)  # also any, mixed, bare
    views: tuple[str, ...] = ("morpheus",)  # names in `VIEWS`
    diameter: Range | None = None  # of the vehicle, m
    clearance: Range | None = None  # over the diameter
    slopes: tuple[float, ...] | None = None  # limits, deg
    cells: Range | None = None  # number of finest cells along the diameter
    noise: Range | None = None  # of the range, over the clearance
    noise_factors: tuple[float, ...] = (1.0,)  # configured over true noise
    outliers: tuple[float, ...] = (0.0,)  # fraction of the returns
    grass: Range | None = None  # its height over the clearance
    dark_loss: Range | None = None  # fraction of the returns lost on dark ground
    weight: float = 1.0  # in a fit


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
        noise_factors=(1.0, 0.75, 1.3),
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
    "meadow": Family(
        grounds=("bare", "bare", "sparse", "smooth", "mixed", "any"),
        views=("sweep", "descent", "wide", "few", "hover"),
        cells=(5.0, 16.0),
        noise=(0.05, 0.15),
        grass=(0.03, 0.35),
        dark_loss=(0.05, 0.8),
    ),
    "hover": Family(
        grounds=(*_ANY, "mixed", "bare"),
        views=("hover",),
        cells=(5.0, 16.0),
        noise=(0.05, 0.3),
        dark_loss=(0.01, 0.5),
    ),
    "any": Family(
        grounds=(*_ANY, "mixed", "bare"),
        views=("sweep", "descent", "oblique", "wide", "few"),
        noise=(0.07, 0.4),
        noise_factors=(1.0, 1.0, 0.8, 1.25),
        outliers=(0.0, 0.0, 0.01),
        weight=0.7,
        **_SIZES,
    ),
}


def ground(rng: np.random.Generator, kind: str) -> Terrain:
    """Make 80 x 80 m of a field in `FIELDS`, or of ``any``, ``plain``, ``cratered``, ``bare`` (an
    incline), or ``mixed`` ground: two of these, in halves or patches."""
    if kind == "mixed":
        one, two = rng.choice(_MIXED_PAIRS)
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


_MIXED_PAIRS = (
    ("rocky", "bare"),
    ("any", "any"),
    ("cratered", "plain"),
    ("rocky", "smooth"),
    ("rough", "plain"),
    ("default", "cratered"),
)


@dataclass(frozen=True)
class View:
    """Times (S,), s, and true poses (S, 3), (S, 3, 3) of scans, and their beams."""

    times: Array
    positions: Array
    rotations: Array
    beams: Array


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw from a log-uniform distribution."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _morpheus(rng: np.random.Generator) -> View:
    """Section VII: 20 s at 20 Hz from 450 m on a glide slope of 30 deg."""
    return _sweep_view(Sweep((0.0, 0.0, 0.0), HALF_SIDE, HALF_SIDE, 20.0, 1.0), 20.0, 128)


def _sweep(rng: np.random.Generator) -> View:
    """A sweep as of `_morpheus`, but closer, steeper and with fewer scans."""
    duration, slant = rng.uniform(5.0, 25.0), rng.uniform(120.0, 450.0)
    seen = (0.0, 0.0, 0.0), HALF_SIDE, HALF_SIDE, duration, log_uniform(rng, 1.0, 5.0)
    sweep = Sweep(
        *seen,
        slant_range=slant,
        glide_slope_deg=rng.uniform(25.0, 80.0),
        approach_speed=rng.uniform(1.0, 0.4 * slant / duration),
        reverse=rng.random() < 0.5,
    )
    return _sweep_view(sweep, log_uniform(rng, 2.0, 20.0), int(rng.choice([48, 64, 96, 128])))


def _oblique(rng: np.random.Generator) -> View:
    """A fast approach from about 180 m at about 55 deg that misses much of the ground."""
    duration, slant = rng.uniform(8.0, 16.0), rng.uniform(140.0, 220.0)
    half = HALF_SIDE * rng.uniform(0.5, 1.0)
    centre = rng.uniform(-10.0, 10.0), rng.uniform(-10.0, 10.0), 0.0
    sweep = Sweep(
        *(centre, half, half, duration, float(rng.integers(1, 4))),
        slant_range=slant,
        glide_slope_deg=rng.uniform(45.0, 65.0),
        approach_speed=0.4 * slant / duration,
        overlap=float(rng.choice([-0.6, -0.3, 0.0, 0.2])),
        reverse=rng.random() < 0.5,
    )
    return _sweep_view(sweep, log_uniform(rng, 2.0, 20.0), int(rng.choice([48, 64, 96, 128])))


def _sweep_view(sweep: Sweep, rate: float, pixels: int) -> View:
    times = np.arange(0.05 / rate, sweep.duration, 1.0 / rate)
    fov = sweep.field_of_view_deg
    return View(times, *sweep.trajectory().poses(times), pixel_beams(fov, fov, pixels, pixels))


def _descent(rng: np.random.Generator) -> View:
    """A descent to a point near the centre."""
    high, fov, pixels = rng.uniform(90.0, 250.0), rng.uniform(8.0, 35.0), rng.choice([48, 64, 128])
    begin = np.array([*rng.uniform(-45.0, 45.0, 2), high])
    end = np.array([*rng.uniform(-12.0, 12.0, 2), high * rng.uniform(0.15, 0.8)])
    times, at = _straight_pass(rng, begin, end)
    aims = np.tile([*rng.uniform(-10.0, 10.0, 2), 0.0], (len(times), 1))
    beams = pixel_beams(fov, fov, int(pixels), int(pixels))
    return View(times, at, look_at(at, aims, NORTH), beams)


def _wide(rng: np.random.Generator, rate: float | None = None) -> View:
    """A pass with a wide or a spinning lidar; scans at a rate, Hz, or at random times."""
    high = rng.uniform(90.0, 190.0)
    begin = np.array([*rng.uniform(-45.0, 45.0, 2), high])
    end = np.array([*(-begin[:2] * rng.uniform(0.2, 1.0)), high * rng.uniform(0.5, 1.0)])
    times, at = _straight_pass(rng, begin, end, rate)
    aims = np.column_stack([at[:, :2] + rng.uniform(-0.2, 0.2, 2) * high, np.zeros(len(at))])
    lines = int(rng.choice([16, 32, 64])) if rng.random() < 0.6 else 0
    pixels, fov = int(rng.choice([64, 96, 128])), rng.uniform(40.0, 80.0)
    shape = (int(rng.choice([256, 512])), lines) if lines else (pixels, pixels)
    down = rng.uniform(22.0, 60.0) if lines else fov
    return View(times, at, look_at(at, aims, NORTH), pixel_beams(fov, down, *shape))


def _few(rng: np.random.Generator) -> View:
    """Few scans: 0.3 to 40 returns on a square of the clearance."""
    fov, high = rng.uniform(12.0, 40.0), rng.uniform(80.0, 220.0)
    tilt = np.radians(rng.uniform(0.0, 60.0)) * (rng.random() < 0.5)
    rows, columns = int(rng.choice([16, 32, 48, 64, 128])), int(rng.choice([32, 64, 128]))
    area = (2.0 * high * np.tan(np.radians(0.5 * fov))) ** 2 / np.cos(tilt)
    count = int(np.clip(log_uniform(rng, 0.3, 40.0) * area / (0.09 * rows * columns), 4, 200))
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


def _hover(rng: np.random.Generator) -> View:
    """Hover at one to six positions, each for many nearly identical scans."""
    places, high = int(rng.integers(1, 7)), rng.uniform(60.0, 190.0)
    stays = rng.integers(5, 40, places)
    count = int(stays.sum())
    at = np.column_stack([rng.uniform(-20.0, 20.0, (places, 2)), np.full(places, high)])
    aims = np.column_stack([rng.uniform(-8.0, 8.0, (places, 2)), np.zeros(places)])
    at, aims = (np.repeat(of, stays, axis=0) for of in (at, aims))
    sway = log_uniform(rng, 0.003, 0.1)
    at, aims = (of + rng.normal(0.0, sway, of.shape) for of in (at, aims))
    fov, pixels = rng.uniform(20.0, 45.0), int(rng.choice([64, 96, 128]))
    return View(
        0.1 * np.arange(count), at, look_at(at, aims, NORTH), pixel_beams(fov, fov, pixels, pixels)
    )


def _straight_pass(
    rng: np.random.Generator, begin: Array, end: Array, rate: float | None = None
) -> tuple[Array, Array]:
    """Times (at a rate, or 12 to 119 random ones) and positions of a flight between two points."""
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
    "hover": _hover,
}


@dataclass(frozen=True)
class Cover:
    """Patches of grass and of dark ground."""

    height: float  # of the grass, m; returns come from anywhere up to it
    dark_loss: float  # fraction of the returns that is lost on dark ground
    waves: Array  # (4, 3) wave numbers along x and y, rad/m, and phases of the patches

    @staticmethod
    def draw(rng: np.random.Generator, family: Family, clearance: float, scale: float) -> Cover:
        """Draw the cover of a flight over ground that is scaled by ``scale``."""
        height, dark_loss = (
            0.0 if of is None else log_uniform(rng, *of) for of in (family.grass, family.dark_loss)
        )
        length = np.exp(rng.uniform(np.log(3.0), np.log(30.0), 4)) * scale
        turn, phase = rng.uniform(0.0, 2.0 * np.pi, (2, 4))
        waves = np.column_stack([np.cos(turn) / length, np.sin(turn) / length]) * 2.0 * np.pi
        return Cover(clearance * height, dark_loss, np.column_stack([waves, phase]))

    def apply(
        self, rng: np.random.Generator, position: Array, directions: Array, ranges: Array
    ) -> None:
        """Shorten ranges (N,), m, along directions (N, 3) by grass; set lost ones to NaN."""
        if not self.height and not self.dark_loss:
            return
        x, y = (position[:2] + ranges[:, None] * directions[:, :2]).T
        sines = np.sin(
            np.outer(self.waves[:, 0], x) + np.outer(self.waves[:, 1], y) + self.waves[:, 2:]
        )
        grass, dark = (0.5 + 0.25 * (sines[k] + sines[k + 1]) for k in (0, 2))
        down = np.maximum(-directions[:, 2], 0.2)
        ranges -= self.height * grass * rng.random(ranges.shape) / down
        ranges[rng.random(ranges.shape) < self.dark_loss * (dark > 0.6)] = np.nan
