# SPDX-License-Identifier: Apache-2.0
"""Simulated flights, cached in memory."""

from __future__ import annotations

import functools
import os
from dataclasses import dataclass
from pathlib import Path

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.desk.replay.replay import scans
from quadtree_lss.lab.campaign.flights import in_memory
from quadtree_lss.lab.evaluation.results import Truth, truth_of
from quadtree_lss.lab.simulation.simulate import Simulation
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.messages.intake import ReadyScan


def data_folder() -> Path:
    """Folder of recordings and measured terrains: ``QUADTREE_LSS_DATA``, by default
    ``../shared/data`` beside the repository."""
    default = Path(__file__).resolve().parents[3] / "shared" / "data"
    return Path(os.environ.get("QUADTREE_LSS_DATA", default))


@dataclass(frozen=True)
class Recording:
    """The scans of a flight as a mapper receives them, and the truth."""

    scans: list[ReadyScan]
    truth: Truth


def configuration(*names: str, **changes: object) -> Config:
    """Load shipped configurations in order, with changes as ``section__key``."""
    return load_config(names, {k.replace("__", "."): v for k, v in changes.items()})


@functools.lru_cache(maxsize=12)
def recording(
    scenario: str, seed: int, duration: float | None = None, terrain: str | None = None
) -> Recording:
    """Simulate a flight, optionally of a shorter ``duration``, s, or over an elevation model."""
    flight = Simulation(scenario, seed, duration=duration, terrain=terrain)
    found = list(scans(in_memory(flight), configuration(scenario)))
    return Recording(found, truth_of(flight.truth()))
