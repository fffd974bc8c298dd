# SPDX-License-Identifier: Apache-2.0
"""One flight in lock-step, from a seed and settings to figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from quadtree_lss.desk.replay.history import History
from quadtree_lss.desk.replay.passes import TargetChange
from quadtree_lss.lab.flight.flight import Flight, Sent, flight_config
from quadtree_lss.lab.flight.ground import Ground
from quadtree_lss.lab.flight.lockstep import LockstepNodes
from quadtree_lss.lab.flight.pilot import Target
from quadtree_lss.lab.flight.settings import FlightSettings
from quadtree_lss.onboard.core.landing.assessment import LandingAssessment
from quadtree_lss.onboard.core.mapping.prior_offset import PriorOffset
from quadtree_lss.onboard.core.tree.cell_map import CellMap

OUTSIDE = {"kill_lss": "lss", "kill_mapping": "mapping", "forget_mapping": "mapping"}
"""Faults that hit a node."""


class Nodes(Protocol):
    """mapping_node and lss_node as a flight has them: in lock-step, or as processes."""

    def take(self, sent: Sent, now_ns: int) -> None:
        """A message of the flight."""

    def work(self, now_ns: int) -> Sequence[Target]:
        """Whatever is due at a time of the flight; what ``landing/selected`` says until then."""

    def land_now(self) -> None:
        """Calls the service of that name."""

    def kill(self, node: str) -> None:
        """``mapping`` or ``lss`` is no more."""

    def respawn(self, node: str, *, checkpoint: bool = True) -> None:
        """It is back, the mapper with its checkpoint or without."""


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
    fly(flight, nodes, progress)
    last = None if nodes is None else nodes.last
    figures = figures_of(seed, flight, last)
    prior = None if nodes is None else nodes.prior_offset
    if nodes is None or not record:
        return Flown(flight, figures, last, prior=prior)
    cells, at_end = nodes.finish(flight.stamp_ns)
    recorded = nodes.history, tuple(nodes.targets), nodes.told
    return Flown(flight, figures, at_end, cells, *recorded, prior)


def fly(flight: Flight, nodes: Nodes | None, progress: Callable[[float], None] | None) -> None:
    """To its end, with the nodes, if it has some, and what befalls them."""
    before: set[str] = set()
    while not flight.outcome:
        sent = flight.step()
        if nodes is not None:
            now = set(flight.active)
            if "land_now" in now - before:
                nodes.land_now()
            for kind, node in OUTSIDE.items():
                if kind in now - before:
                    nodes.kill(node)
                elif kind in before - now:
                    nodes.respawn(node, checkpoint=kind != "forget_mapping")
            before = now
            for message in sent:
                nodes.take(message, flight.stamp_ns)
            for said in nodes.work(flight.stamp_ns):
                flight.hear(said)
        if progress is not None and int(100 * flight.time) % 100 == 0:
            progress(flight.time)


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
