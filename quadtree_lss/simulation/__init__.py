# SPDX-License-Identifier: Apache-2.0
"""Simulated descents over known terrain, written as ROS 2 bags.

Shares no code with the mapping system, which it is there to test.
"""

from quadtree_lss.simulation.scenarios import SCENARIOS
from quadtree_lss.simulation.simulate import SimulationResult, simulate
from quadtree_lss.simulation.terrain import SimulationError, Terrain, load_terrain

__all__ = [
    "SCENARIOS",
    "SimulationError",
    "SimulationResult",
    "Terrain",
    "load_terrain",
    "simulate",
]
