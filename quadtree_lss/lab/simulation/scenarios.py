# SPDX-License-Identifier: Apache-2.0
"""Scenarios: named flights that can be simulated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from quadtree_lss.lab.simulation.hazard_field import HazardField, add_rocks_to, hazard_field
from quadtree_lss.lab.simulation.lidar import FlashLidar, StereoCamera
from quadtree_lss.lab.simulation.safety import LandingGear
from quadtree_lss.lab.simulation.terrain import (
    SimulationError,
    Terrain,
    check,
    load_terrain,
    parabola,
)
from quadtree_lss.lab.simulation.trajectory import (
    DriftingNavigation,
    Navigation,
    Sweep,
    Trajectory,
    WhiteNavigation,
    descent_trajectory,
    section_vi_trajectory,
)
from quadtree_lss.onboard.arrays import Array

#: Spacing of the true safety map and of the corners of boxes, m.
GRID_SPACING = 0.25
#: Distance between a box and the edge of a DEM, m; more than the radius of the lander.
EDGE = 2.25
#: Time by which the poses begin before and end after the scans, s.
LEAD = 0.1


@dataclass(frozen=True)
class FlightPlan:
    """Ground, sensor, trajectory, navigation and times (s) of one flight."""

    terrain: Terrain
    lidar: FlashLidar
    trajectory: Trajectory
    navigation: Navigation
    scan_times: Array
    pose_times: Array
    box: tuple[float, float, float, float]
    spacing: float = GRID_SPACING


LIMITS = {
    "duration": (1.0, 600.0),
    "range_noise": (0.0, 1e6),
    "outliers": (0.0, 1.0),
    "dropouts": (0.0, 1.0),
    "glide_slope_deg": (10.0, 80.0),
    "navigation_error": (0.0, 100.0),
    "rocks": (0.0, 0.3),
    "slope_deg": (0.0, 20.0),
    "flights": (1, 1000),
}


@dataclass(frozen=True)
class Conditions:
    """Conditions of a flight; None takes the value of the scenario. Raises `SimulationError`: a
    value is out of its limits."""

    duration: float | None = None  # s
    terrain: Terrain | str | Path | None = None  # a DEM or its path
    range_noise: float | None = None  # 1 sigma, m
    outliers: float = 0.0  # fraction of false returns
    dropouts: float = 0.0  # fraction of missing returns
    glide_slope_deg: float = 30.0  # of the morpheus scenario
    navigation_error: float = 1.0  # factor on the errors of all scenarios except parabola
    rocks: float | None = None  # fraction of the ground under rocks; added to a terrain
    slope_deg: float | None = None  # RMS slope of a simulated field
    flights: int = 1  # over the same ground, each with new navigation errors

    def __post_init__(self) -> None:
        check(self, LIMITS, SimulationError)

    def ground(self, scenario: str, generator: np.random.Generator) -> Terrain:
        """Make or read the ground of a scenario."""
        terrain, rocks, slope_deg = self.terrain, self.rocks, self.slope_deg
        if isinstance(terrain, (str, Path)):
            terrain = load_terrain(terrain)
        if terrain is not None:
            if slope_deg is not None:
                raise SimulationError("slope_deg applies to simulated fields, not to a terrain")
            return add_rocks_to(generator, terrain, rocks) if rocks else terrain
        field: dict[str, Any] = {"rock_abundance": rocks, "slope_rms_deg": slope_deg}
        field = {name: value for name, value in field.items() if value is not None}
        if scale := SCENARIOS[scenario].scale:
            return hazard_field(generator, HazardField(**field)).scaled(scale)
        if field:
            raise SimulationError(f"{scenario} simulates no field: rocks need a terrain")
        return parabola()

    def lidar(self, field_of_view_deg: float, range_noise: float) -> FlashLidar:
        noise = range_noise if self.range_noise is None else self.range_noise
        return FlashLidar(field_of_view_deg, 128, noise, self.outliers, self.dropouts)

    def drifting(self, attitude_bias_deg: float, attitude_drift_deg: float) -> DriftingNavigation:
        default, factor = DriftingNavigation(), self.navigation_error
        place = factor * default.position_bias, factor * default.position_drift
        turn = factor * attitude_bias_deg, factor * attitude_drift_deg
        return DriftingNavigation(*place, *turn)


def _box(terrain: Terrain, half: float) -> tuple[float, float, float, float]:
    """Square box around the centre of the terrain, a distance `EDGE` within its edges."""
    xmin, xmax, ymin, ymax = terrain.bounds
    middles = 0.5 * (xmin + xmax), 0.5 * (ymin + ymax)
    x, y = (GRID_SPACING * round(middle / GRID_SPACING) for middle in middles)
    room = min(x - xmin, xmax - x, y - ymin, ymax - y) - EDGE
    half = GRID_SPACING * float(np.floor(min(half, room) / GRID_SPACING + 1e-9))
    if half < 2.0:
        raise SimulationError("terrain: too small; a scan needs a DEM of at least 9 m by 9 m")
    return x - half, x + half, y - half, y + half


def _centre(terrain: Terrain, box: tuple[float, float, float, float]) -> Array:
    x, y = 0.5 * (box[0] + box[1]), 0.5 * (box[2] + box[3])
    return np.array([x, y, float(terrain.elevation_at(x, y))])


def _times(duration: float, rate: float, first: float = 0.0) -> Array:
    return first + np.arange(int(np.floor(duration * rate + 1e-9)) + 1, dtype=np.float64) / rate


def _parabola(conditions: Conditions, terrain: Terrain, duration: float, flight: int) -> FlightPlan:
    """Section VI; a shorter ``duration`` ends the flight early."""
    target_z = float(terrain.elevation_at(10.0, 0.0))
    if not np.isfinite(target_z):
        raise SimulationError("terrain: it does not cover (10, 0) m, where the lidar points")
    times = _times(min(duration, 60.0), 1.0)
    trajectory, lidar = section_vi_trajectory(target_z), conditions.lidar(10.0, 0.08)
    box = _box(terrain, 60.0)
    return FlightPlan(terrain, lidar, trajectory, WhiteNavigation(), times, times, box)


def _morpheus(conditions: Conditions, terrain: Terrain, duration: float, flight: int) -> FlightPlan:
    """Section VII; a shorter ``duration`` sweeps a smaller box (at least 20 m) as densely."""
    box = _box(terrain, float(np.clip(30.0 * np.sqrt(duration / 20.0), 10.0, 30.0)))
    rate = 20.0
    area = tuple(_centre(terrain, box)), 0.5 * (box[1] - box[0]), 0.5 * (box[3] - box[2])
    how = {"glide_slope_deg": conditions.glide_slope_deg, "reverse": flight % 2 == 1}
    trajectory = Sweep(*area, duration, field_of_view_deg=1.0, **how).trajectory()
    # Scans at 20 Hz, between poses.
    scans = (np.arange(int(np.floor(duration * rate + 1e-9)), dtype=np.float64) + 0.37 / 5.0) / rate
    poses = _times(duration + 2.0 * LEAD, 100.0, -LEAD)
    lidar, navigation = conditions.lidar(1.0, 0.06), conditions.drifting(0.01, 0.0015)
    return FlightPlan(terrain, lidar, trajectory, navigation, scans, poses, box)


@dataclass(frozen=True)
class LookingDown:
    """Plan of a descent between two ``heights``, m, over a box of ``half`` side, m, with scans at a
    ``rate``, Hz. ``lidar``: field of view, deg, and noise, m; None for a stereo camera."""

    half: float
    rate: float
    heights: tuple[float, float]
    lidar: tuple[float, float] | None
    spacing: float = GRID_SPACING

    def __call__(
        self, conditions: Conditions, terrain: Terrain, duration: float, flight: int
    ) -> FlightPlan:
        if self.lidar is None and (conditions.range_noise is not None or conditions.outliers):
            raise SimulationError("a stereo camera has neither range_noise nor outliers")
        box = _box(terrain, self.half)
        trajectory = descent_trajectory(_centre(terrain, box), duration, *self.heights)
        count = max(int(np.floor(duration * self.rate + 1e-9)), 1)
        scans = (np.arange(count, dtype=np.float64) + 0.137) / self.rate
        poses = _times(duration + 2.0 * LEAD, 50.0, -LEAD)
        camera = StereoCamera(dropouts=conditions.dropouts)
        sensor = conditions.lidar(*self.lidar) if self.lidar else camera
        navigation = conditions.drifting(0.02, 0.005)
        return FlightPlan(terrain, sensor, trajectory, navigation, scans, poses, box, self.spacing)


@dataclass(frozen=True)
class Scenario:
    """A named flight: plan, duration, s, scale of its field (0: parabola), and default lander."""

    plan: Callable[[Conditions, Terrain, float, int], FlightPlan]
    duration: float
    scale: float = 1.0
    lander: LandingGear = LandingGear()


_SMALL = LandingGear(0.6, 0.02, 10.0, 0.08)
_FINE = 0.25 * GRID_SPACING
_DESCENT = LookingDown(30.0, 5.0, (200.0, 50.0), (20.0, 0.06))
_DRONE = LookingDown(8.0, 10.0, (25.0, 15.0), (60.0, 0.02), _FINE)
_DEPTH = LookingDown(4.0, 5.0, (15.0, 3.0), None, _FINE)
SCENARIOS: dict[str, Scenario] = {
    "morpheus": Scenario(_morpheus, 20.0),
    "parabola": Scenario(_parabola, 60.0, 0.0),
    "descent": Scenario(_DESCENT, 30.0),
    "depth": Scenario(_DEPTH, 10.0, 0.35, _SMALL),
    "drone": Scenario(_DRONE, 10.0, 0.35, _SMALL),
}
