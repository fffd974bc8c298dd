# SPDX-License-Identifier: Apache-2.0
"""One flight in lock-step, from a seed and settings to figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from quadtree_lss.desk.replay.history import History
from quadtree_lss.desk.replay.passes import TargetChange
from quadtree_lss.lab.flight.flight import Flight, flight_config
from quadtree_lss.lab.flight.ground import Ground
from quadtree_lss.lab.flight.lockstep import LockstepNodes
from quadtree_lss.lab.flight.settings import FlightSettings
from quadtree_lss.onboard.core.landing.assessment import LandingAssessment
from quadtree_lss.onboard.core.mapping.prior_offset import PriorOffset
from quadtree_lss.onboard.core.tree.cell_map import CellMap

OUTSIDE = {"kill_lss": "lss", "kill_mapping": "mapping", "forget_mapping": "mapping"}
"""Faults that hit a node."""
LAND_NOW = "land_now"
"""The one that calls a service."""


@dataclass(frozen=True)
class Flown:
    """A flight that has ended. ``flight``: its state at the end, with its record. ``figures``: see
    ``docs/topics_and_files.md``. ``last``: what the nodes said last, None without them. Where it
    was recorded: ``cells``, the map at the end; ``history``, what became of it; ``targets``, the
    changes of the target; ``told``, more for its summary. ``prior``: how far the map lay from its
    prior, None without."""

    flight: Flight
    figures: dict[str, Any]
    last: LandingAssessment | None
    cells: CellMap | None = None
    history: History | None = None
    targets: tuple[TargetChange, ...] = ()
    told: dict[str, Any] = field(default_factory=dict)
    prior: PriorOffset | None = None


def flown(
    seed: int,
    settings: FlightSettings,
    *,
    ground: Ground | None = None,
    progress: Callable[[float], None] | None = None,
    record: bool = False,
) -> Flown:
    """One flight; with ``record`` all that its page shows. ``ground`` is of this seed, if it is
    there already; ``progress`` is told the seconds flown."""
    flight = Flight(seed, settings, ground)
    nodes = None
    if flight.looks:
        config = flight_config(settings, flight.ground)
        history = History() if record else None
        nodes = LockstepNodes(config, settings.answer_delay, history, flight.prior)
    down: set[str] = set()
    asked = False
    while not flight.outcome:
        sent = flight.step()
        if nodes is not None:
            if LAND_NOW in flight.active and not asked:
                asked = True
                nodes.land_now()
            for kind, node in changed(flight, down):
                if kind in down:
                    nodes.kill(node)
                else:
                    nodes.respawn(node, checkpoint=kind != "forget_mapping")
            for message in sent:
                nodes.take(message, flight.stamp_ns)
            said = nodes.work(flight.stamp_ns)
            if said is not None:
                flight.hear(said)
        if progress is not None and int(100 * flight.time) % 100 == 0:
            progress(flight.time)
    last = None if nodes is None else nodes.last
    figures = figures_of(seed, flight, last)
    prior = None if nodes is None else nodes.prior_offset
    if nodes is None or not record:
        return Flown(flight, figures, last, prior=prior)
    cells, at_end = nodes.finish(flight.stamp_ns)
    recorded = nodes.history, tuple(nodes.targets), nodes.told
    return Flown(flight, figures, at_end, cells, *recorded, prior)


def figures_of(seed: int, flight: Flight, last: LandingAssessment | None) -> dict[str, Any]:
    """What became of a flight, ready for JSON."""
    figures = {"seed": seed, "avoidance": flight.settings.avoidance, **flight.result()}
    warnings = "; ".join(() if last is None else last.doubts)
    return figures | map_said(last, figures) | {"warnings": warnings}


def map_said(last: LandingAssessment | None, figures: Mapping[str, Any]) -> dict[str, Any]:
    """What the last map said of the ground of the touchdown: safe, unsafe, unseen, unmapped
    (seen, not yet mapped) or nothing."""
    said = "nothing"
    if last is not None:
        column = int(np.abs(last.x - figures["x"]).argmin())
        row = int(np.abs(last.y - figures["y"]).argmin())
        said = "safe" if last.safe[row, column] else "margin"
        if last.hazard[row, column] & 0x80:
            said = "unmapped" if last.hazard[row, column] & 0x40 else "unseen"
        elif last.hazard[row, column] & 0x08:
            said = "unsafe"
    return {"map_said": said}


def changed(flight: Flight, down: set[str]) -> list[tuple[str, str]]:
    """Faults that begin now, which ``down`` has then, or end, each with the node that it hits."""
    found = [(k, node) for k, node in OUTSIDE.items() if (k in flight.active) != (k in down)]
    down ^= {kind for kind, _ in found}
    return found
