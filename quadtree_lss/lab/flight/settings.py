# SPDX-License-Identifier: Apache-2.0
"""Settings of a flight: ground, sensors, guidance, faults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from quadtree_lss.lab.flight.gimbal import ScanPlan
from quadtree_lss.lab.flight.pilot import Rules
from quadtree_lss.lab.flight.vehicle import Vehicle
from quadtree_lss.lab.simulation.scenarios import LIMITS as SIMULATION_LIMITS
from quadtree_lss.lab.simulation.terrain import check
from quadtree_lss.onboard.errors import QuadtreeLssError

#: By the nodes; by the nodes with the paper's rules; to the planned point; by the true ground.
AVOIDANCE = ("package", "paper", "none", "perfect")
FAULTS = tuple(
    "kill_lss kill_mapping forget_mapping pose_gap pose_jump lidar_gap keep_out land_now".split()
)
LIMITS = {
    name: SIMULATION_LIMITS[name]
    for name in ("range_noise", "outliers", "dropouts", "glide_slope_deg")
}
LIMITS |= {"half": (2.0, 1e4), "slant_range": (20.0, 1e5)}
LIMITS |= {"speed": (0.0, 1e3), "scatter": (0.0, 1e3)}
#: Largest height, m, and duration, s, of a fault.
MAX_FAULT_VALUE = 1e4


class FlightError(QuadtreeLssError):
    """Invalid settings of a flight."""


@dataclass(frozen=True)
class Fault:
    """A fault: its kind (``studies/RESULTS.md``), its begin as a height over the aim, m,
    and its duration, s. A keep-out lasts until the next one, ``land_now`` until the end."""

    kind: str
    height: float
    seconds: float = 3.0

    def __post_init__(self) -> None:
        if self.kind not in FAULTS:
            raise FlightError(f"unknown fault {self.kind!r}; there are {', '.join(FAULTS)}")
        if not (0.0 <= self.height <= MAX_FAULT_VALUE and 0.0 < self.seconds <= MAX_FAULT_VALUE):
            given = f"{self.kind} at {self.height:g} m for {self.seconds:g} s"
            raise FlightError(f"fault {given}: from 0 to {MAX_FAULT_VALUE:g}")

    @classmethod
    def read(cls, text: str) -> Fault:
        """Parse ``kind@height`` or ``kind@height+seconds``. Raises `FlightError`: neither."""
        kind, _, when = text.partition("@")
        height, _, seconds = when.partition("+")
        try:
            return cls(kind, float(height), float(seconds or 3.0))
        except ValueError:
            expected = "KIND@HEIGHT or KIND@HEIGHT+SECONDS"
            raise FlightError(f"fault {text!r}: expected {expected}") from None


@dataclass(frozen=True)
class FlightSettings:
    """Settings of a flight; m, m/s."""

    avoidance: str = "package"
    terrain: str = ""  # file as in ``simulate --terrain``; empty: a field of rocks and craters
    rocks: float | None = None  # None: 0.05 on that field, 0 on a terrain
    range_noise: float = 0.06
    outliers: float = 0.0
    dropouts: float = 0.0
    half: float = 25.0  # half side of the candidate area around the planned point
    slant_range: float = 600.0
    speed: float = 40.0
    glide_slope_deg: float = 30.0
    scatter: float = 10.0  # 1 sigma of the initial position; a twentieth of it for the velocity
    config: Mapping[str, Any] = field(default_factory=dict)  # overrides ``config/flight.yaml``
    vehicle: Vehicle = field(default_factory=Vehicle)
    rules: Rules = field(default_factory=Rules)
    plan: ScanPlan = field(default_factory=ScanPlan)
    faults: tuple[Fault, ...] = ()

    def __post_init__(self) -> None:
        if self.avoidance not in AVOIDANCE:
            there = ", ".join(AVOIDANCE)
            raise FlightError(f"unknown avoidance {self.avoidance!r}; there are {there}")
        check(self, LIMITS, FlightError)
        check(self.plan, {"survey": (0.1, 1e3)}, FlightError)


def flight_settings(values: Mapping[str, Any]) -> FlightSettings:
    """Make settings of plain values: ``faults`` are parsed by `Fault.read`, ``survey`` is part of
    the scan plan. Raises `FlightError`: an unknown name or an invalid value."""
    given, known = dict(values), sorted(item.name for item in fields(FlightSettings))
    if "survey" in given:
        given["plan"] = ScanPlan(survey=given.pop("survey"))
    if unknown := [name for name in given if name not in known]:
        msg = f"unknown setting {unknown[0]!r} of a flight; there are {', '.join(known)}"
        raise FlightError(msg)
    given["faults"] = tuple(Fault.read(str(fault)) for fault in given.get("faults", ()))
    return FlightSettings(**given)
