# SPDX-License-Identifier: Apache-2.0
"""Simulated descents over known terrain, written as ROS 2 bags; no code in common with mapping."""

from quadtree_lss import build

build.check()

from quadtree_lss.lab.simulation.scenarios import SCENARIOS  # noqa: E402
from quadtree_lss.lab.simulation.simulate import SimulationResult, simulate  # noqa: E402
from quadtree_lss.lab.simulation.terrain import SimulationError, Terrain, load_terrain  # noqa: E402

__all__ = [
    "SCENARIOS",
    "SimulationError",
    "SimulationResult",
    "Terrain",
    "load_terrain",
    "simulate",
]
