# SPDX-License-Identifier: Apache-2.0
"""Kinds of flights: names in `REGISTERED`, or a ``module:attribute`` of the user.

The figures of a flight depend only on its `Case`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from quadtree_lss.onboard.errors import QuadtreeLssError

REGISTERED = {
    "map": "quadtree_lss.lab.campaign.flights:MAP",
    "fly": "quadtree_lss.lab.campaign.flights:FLY",
}

Value = float | int | str | bool | None
Figures = dict[str, Value]


#: Conditions and parameters that name a file, whose content determines the flight.
FILES = ("terrain", "lss.risk_model")


class CampaignError(QuadtreeLssError):
    """A study or campaign cannot be run."""


@dataclass(frozen=True)
class Case:
    """One flight of a study, with ``conditions`` that differ from those of the scenario, all
    ``parameters`` by dotted key, ``labels`` that vary over the study, and the package's build."""

    index: int
    kind: str
    scenario: str
    seed: int
    conditions: Mapping[str, Value] = field(default_factory=dict)
    parameters: Mapping[str, Any] = field(default_factory=dict)
    labels: Mapping[str, Value] = field(default_factory=dict)
    version: str = ""
    build: str = ""


@dataclass(frozen=True)
class Record:
    """Figures or error of a flight, and its case; ``key`` is a hash of what determines it."""

    index: int
    seed: int
    scenario: str
    labels: dict[str, Value]
    figures: Figures
    error: str = ""
    key: str = ""
    version: str = ""
    build: str = ""


@dataclass(frozen=True)
class Quantity:
    """A figure of the summary and its unfavourable end. With ``of``, the figure with the number of
    trials, it counts events."""

    name: str
    label: str
    unit: str = ""
    digits: int = 2
    worst: Literal["smallest", "largest"] = "largest"
    of: str | None = None

    @property
    def title(self) -> str:
        return f"{self.label} [{self.unit}]" if self.unit else self.label


@dataclass(frozen=True)
class Kind:
    """Functions and quantities of a kind of flight. ``fly`` may raise `QuadtreeLssError`; ``keep``
    writes all results into a folder."""

    fly: Callable[[Case], Figures]
    keep: Callable[[Case, Path], None]
    scenarios: Collection[str]
    conditions: Collection[str]
    quantities: tuple[Quantity, ...]


def kind_of(name: str) -> Kind:
    """Return the kind with that name, or the one at ``module:attribute``."""
    module, colon, attribute = REGISTERED.get(name, name).partition(":")
    if colon:
        try:
            kind = getattr(importlib.import_module(module), attribute)
        except Exception as error:
            raise CampaignError(f"kind {name!r} cannot be imported: {error}") from error
        if isinstance(kind, Kind):
            return kind
    raise CampaignError(f"unknown kind {name!r}; there are {', '.join(sorted(REGISTERED))}")
