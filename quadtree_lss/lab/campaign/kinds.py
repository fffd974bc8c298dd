# SPDX-License-Identifier: Apache-2.0
"""Kinds of flights that a study can be of, and what is told of each.

A kind is registered by its name in `REGISTERED`, as ``module:attribute``; a study may also name one
of its own so. What it flies is a function of a `Case` alone: the same case gives the same figures,
in any process and any order.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from quadtree_lss.onboard.errors import QuadtreeLssError

REGISTERED = {
    "map": "quadtree_lss.lab.campaign.mapped:MAP",
    "fly": "quadtree_lss.lab.campaign.landings:FLY",
}

Value = float | int | str | bool | None
Figures = dict[str, Value]
"""Numbers of a flight by name, the same whenever it is flown."""


class CampaignError(QuadtreeLssError):
    """A study or a campaign that cannot be run as asked; the text is one clear line."""


@dataclass(frozen=True)
class Case:
    """One flight of a study, with everything decided: its number, from 0; the seed of all that is
    random in it; ``conditions`` that differ from the scenario's own, by the names that the kind
    knows; all ``parameters``, dotted; ``labels``: what varies over the study, for tables and plots;
    version and build of the package that is to fly it."""

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
class Quantity:
    """A figure that the summary tells, and which end of it is bad.

    With ``of``, the name of another figure, it counts events: so many of so many.
    """

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
    """How to fly a case, and what its figures mean. ``fly`` raises `QuadtreeLssError` if it fails;
    ``keep`` leaves everything there is to see in a folder, with a ``page``. A study may use the
    names of ``scenarios`` and ``conditions``. The page's points show ``first`` first (empty: the
    first mean), and it may be explained ``by`` those figures, beside what the study varies."""

    fly: Callable[[Case], Figures]
    keep: Callable[[Case, Path], None]
    page: str
    scenarios: Collection[str]
    conditions: Collection[str]
    quantities: tuple[Quantity, ...]
    first: str = ""
    by: tuple[str, ...] = ()


def kind_of(name: str) -> Kind:
    """The kind of that name, or of that ``module:attribute``."""
    module, colon, attribute = REGISTERED.get(name, name).partition(":")
    if colon:
        try:
            kind = getattr(importlib.import_module(module), attribute)
        except Exception as error:  # whatever it does when it is imported
            raise CampaignError(f"kind {name!r} cannot be imported: {error}") from error
        if isinstance(kind, Kind):
            return kind
    raise CampaignError(f"unknown kind {name!r}; there are {', '.join(sorted(REGISTERED))}")
