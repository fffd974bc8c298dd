# SPDX-License-Identifier: Apache-2.0
"""The true ground of a flight, its true safety, and the start of the flight."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import distance_transform_edt

from quadtree_lss.lab.flight.settings import FlightSettings
from quadtree_lss.lab.simulation import safety
from quadtree_lss.lab.simulation.scenarios import Conditions
from quadtree_lss.lab.simulation.terrain import SimulationError, Terrain
from quadtree_lss.onboard.arrays import Array

#: Spacing of the points that ``perfect`` avoidance chooses from, m.
GRID = 0.25


@dataclass(frozen=True)
class Ground:
    """True terrain, the planned landing point (3,) and the half side of the candidate area, m."""

    terrain: Terrain
    planned: Array
    half: float

    @classmethod
    def of(cls, settings: FlightSettings, generator: np.random.Generator) -> Ground:
        """Make the ground of the settings. On a DEM the planned point is drawn within 100 m of its
        centre. Raises `SimulationError`: the terrain cannot be read or is too small."""
        given = Conditions(terrain=settings.terrain or None, rocks=settings.rocks)
        terrain = given.ground("morpheus", generator)
        xmin, xmax, ymin, ymax = terrain.bounds
        x, y = (GRID * round(0.5 * (a + b) / GRID) for a, b in ((xmin, xmax), (ymin, ymax)))
        clearance = 0.5 * min(xmax - xmin, ymax - ymin) - 4.0
        if clearance < 2.0:
            raise SimulationError("terrain: too small; a flight needs 12 m by 12 m")
        if settings.terrain:
            spread = float(np.clip(clearance - settings.half, 0.0, 100.0))
            x, y = (c + GRID * round(generator.uniform(-spread, spread) / GRID) for c in (x, y))
        planned = np.array([x, y, float(terrain.elevation_at(x, y))])
        return cls(terrain, planned, min(settings.half, clearance))

    def touches(self, position: Array) -> bool:
        """Whether a lander whose pads are level with ``position`` (3,) is on the ground."""
        if position[2] > self._highest:  # fast path
            return False
        radius = 0.5 * safety.LandingGear().diameter
        angles = 0.25 * np.pi * np.arange(8)
        x = position[0] + radius * np.append(np.cos(angles), 0.0)
        y = position[1] + radius * np.append(np.sin(angles), 0.0)
        heights = self.terrain.elevation_at(x, y)
        highest = np.nanmax(heights) if np.isfinite(heights).any() else self.planned[2] - 20.0
        return bool(position[2] <= highest)

    @cached_property
    def _highest(self) -> float:
        return float(self.terrain.elevation.max())

    @cached_property
    def safe(self) -> tuple[Array, Array, Array]:
        """x, y (n,) of the candidate area and the distance from unsafe ground (n, n), m."""
        n = int(self.half / GRID)
        x = self.planned[0] + GRID * np.arange(-n, n + 1)
        y = self.planned[1] + GRID * np.arange(-n, n + 1)
        safe = safety.safety_map(self.terrain, x, y)
        return x, y, GRID * distance_transform_edt(np.pad(safe, 1))[1:-1, 1:-1]

    def best_point(self) -> Array | None:
        """Point (3,) far from unsafe ground and near the planned one; None without safe ground."""
        x, y, clearance = self.safe
        distance = np.hypot(x[None, :] - self.planned[0], y[:, None] - self.planned[1])
        value = np.where(clearance > 0.0, np.minimum(clearance, 1.5) - 0.01 * distance, -np.inf)
        row, column = divmod(int(np.argmax(value)), len(x))
        if not np.isfinite(value[row, column]):
            return None
        z = float(self.terrain.elevation_at(x[column], y[row]))
        return np.array([x[column], y[row], z])


def start(
    settings: FlightSettings, planned: Array, generator: np.random.Generator
) -> tuple[Array, Array]:
    """Draw the initial position and velocity (3,) around the glide slope along +x."""
    slope = np.radians(settings.glide_slope_deg)
    way = np.array([np.cos(slope), 0.0, -np.sin(slope)])
    position = planned - settings.slant_range * way
    position = position + generator.normal(0.0, settings.scatter, 3)
    velocity = settings.speed * way + generator.normal(0.0, settings.scatter / 20.0, 3)
    return position, velocity
