# SPDX-License-Identifier: Apache-2.0
"""What is flown: the ground, the sensors, the guidance, the faults; checked once, by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from quadtree_lss.lab.flight.gimbal import ScanPlan
from quadtree_lss.lab.flight.pilot import Rules
from quadtree_lss.lab.flight.vehicle import Vehicle
from quadtree_lss.lab.simulation.scenarios import LIMITS as SIMULATED
from quadtree_lss.lab.simulation.terrain import check
from quadtree_lss.onboard.errors import QuadtreeLssError

AVOIDANCE = ("package", "paper", "none", "perfect")
"""By the nodes; by them with the paper's rules; straight to the planned point; by the truth."""

FAULTS = tuple(
    "kill_lss kill_mapping forget_mapping pose_gap pose_jump lidar_gap keep_out land_now".split()
)
LIMITS = {k: SIMULATED[k] for k in "range_noise outliers dropouts glide_slope_deg".split()} | {
    "half": (2.0, 1e4),
    "slant_range": (20.0, 1e5),
    "speed": (0.0, 1e3),
    "scatter": (0.0, 1e3),
    "answer_delay": (0.0, 1e3),
    "longest": (1.0, 1e4),
}
MOST = 1e4
"""Of the height of a fault, m, and of its seconds."""


class FlightError(QuadtreeLssError):
    """A flight that cannot be flown as asked; the text is one clear line."""


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong once.

    Attributes:
        kind: ``kill_lss``, ``kill_mapping`` (it comes back with its checkpoint), ``forget_mapping``
            (it comes back with an empty map), ``pose_gap``, ``pose_jump`` (2 m east, 1 m up, and
            back), ``lidar_gap``, ``keep_out`` (4 m about where the lander is going),
            ``land_now`` (somebody calls that service).
        height: Over the aim at which it begins, m.
        seconds: How long it lasts; a keep-out stays until another one, ``land_now`` for good.
    """

    kind: str
    height: float
    seconds: float = 3.0

    def __post_init__(self) -> None:
        if self.kind not in FAULTS:
            raise FlightError(f"unknown fault {self.kind!r}; there are {', '.join(FAULTS)}")
        if not (0.0 <= self.height <= MOST and 0.0 < self.seconds <= MOST):
            raise FlightError(
                f"fault {self.kind} at {self.height:g} m for {self.seconds:g} s: from 0 to {MOST:g}"
            )

    @classmethod
    def read(cls, text: str) -> Fault:
        """From ``kind@height`` or ``kind@height+seconds``."""
        kind, _, when = text.partition("@")
        height, _, seconds = when.partition("+")
        try:
            return cls(kind, float(height), float(seconds or 3.0))
        except ValueError:
            msg = f"fault {text!r}: expected KIND@HEIGHT or KIND@HEIGHT+SECONDS"
            raise FlightError(msg) from None


@dataclass(frozen=True)
class FlightSettings:
    """Everything about a flight but its seed.

    Attributes:
        avoidance: One of `AVOIDANCE`.
        terrain: As of ``simulate --terrain``; empty for a field of rocks and craters.
        rock_abundance: Share of the ground that rocks cover; None for 0.05 on that field, and none
            on a terrain, over 100 m of which they are strewn otherwise.
        half: Half side of the candidate area about the planned point, m.
        slant_range, speed: At the start, on a glide slope of ``glide_slope_deg``.
        scatter: 1 sigma of the start's place, m; the speed's is a twentieth of it, m/s.
        config: Parameters by dotted key, over ``config/flight.yaml``.
        answer_delay: From a pass's begin to its answer at the guidance in lock-step, s.
        longest: Flights are ended after so many seconds.
    """

    avoidance: str = "package"
    terrain: str = ""
    rock_abundance: float | None = None
    range_noise: float = 0.06
    outliers: float = 0.0
    dropouts: float = 0.0
    half: float = 25.0
    slant_range: float = 600.0
    speed: float = 40.0
    glide_slope_deg: float = 30.0
    scatter: float = 10.0
    config: Mapping[str, Any] = field(default_factory=dict)
    vehicle: Vehicle = field(default_factory=Vehicle)
    rules: Rules = field(default_factory=Rules)
    plan: ScanPlan = field(default_factory=ScanPlan)
    faults: tuple[Fault, ...] = ()
    answer_delay: float = 0.06
    longest: float = 150.0

    def __post_init__(self) -> None:
        if self.avoidance not in AVOIDANCE:
            known = ", ".join(AVOIDANCE)
            raise FlightError(f"unknown avoidance {self.avoidance!r}; there are {known}")
        check(self, LIMITS, FlightError)
        check(self.plan, {"survey": (0.1, 1e3)}, FlightError)


def flight_settings(values: Mapping[str, Any]) -> FlightSettings:
    """From plain values by name, as a study's file holds them: ``faults`` are texts as of
    `Fault.read`; ``vehicle``, ``rules`` and ``plan`` mappings. Raises `FlightError`: a name that
    does not exist, or a value that cannot be used."""
    base, known = FlightSettings(), sorted(item.name for item in fields(FlightSettings))
    given = dict(values)
    if unknown := [name for name in given if name not in known]:
        msg = f"unknown setting {unknown[0]!r} of a flight; there are {', '.join(known)}"
        raise FlightError(msg)
    for name in [part for part in ("vehicle", "rules", "plan") if part in given]:
        try:
            given[name] = replace(getattr(base, name), **given[name])
        except TypeError as error:
            raise FlightError(f"{name}: {error}") from None
    given["faults"] = tuple(Fault.read(str(fault)) for fault in given.get("faults", ()))
    return replace(base, **given)
