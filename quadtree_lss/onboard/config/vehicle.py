# SPDX-License-Identifier: Apache-2.0
"""The vehicle, and the lengths that follow from it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import lru_cache
from math import radians, sqrt, tan
from typing import Any

from quadtree_lss.onboard.config.parameter import declared, live


@dataclass(frozen=True)
class VehicleConfig:
    """What lands; the lengths that mapping and landing go by follow from it."""

    diameter: float = declared(3.7, "diameter of the circle of the pads", (0.05, 1000.0), "m")
    clearance: float = declared(
        0.3,
        "highest ground over the plane of the pads that is tolerated, with compressed struts",
        (0.001, 100.0),
        "m",
    )
    max_slope_deg: float = live(
        10.0,
        "steepest ground that is tolerated; the mapping uses the value at the start",
        (0.1, 89.0),
        "deg",
    )
    pad_radius: float = declared(0.15, "radius of a landing pad", (0.0, 10.0), "m")

    @property
    def diameter_ratio(self) -> float:
        """Its diameter over that of the vehicle that all was tried with."""
        return self._ratio("diameter")

    @property
    def clearance_ratio(self) -> float:
        """Its clearance over that vehicle's."""
        return self._ratio("clearance")

    @property
    def tilt_height(self) -> float:
        """Height under one of its four pads on level ground that leans it too far, m.

        On something of height h the diagonal through that pad carries, its middle h / 2 high. Along
        it the plane of rest falls by h / D, D the diameter, and as much across it, to a third pad
        on the ground: by sqrt(2) h / D in all.
        """
        return self.diameter * tan(radians(self.max_slope_deg)) / sqrt(2.0)

    @property
    def ground_radius(self) -> float:
        """Radius of the disc whose plane is the ground at the vehicle's scale: three quarters of
        its own, m."""
        return 0.75 * 0.5 * self.diameter

    @property
    def least_hazard(self) -> float:
        """Least height of one thing on level ground that makes it fail, m: it rises over the
        clearance, or leans the vehicle too far."""
        return min(self.clearance, self.tilt_height)

    @property
    def lengths(self) -> Lengths:
        """What follows from it."""
        return _lengths(self)

    def _ratio(self, name: str) -> float:
        """Over the vehicle that all was tried with: the defaults, for which this is exactly 1."""
        return float(getattr(self, name) / getattr(_USUAL, name))


_USUAL = VehicleConfig()


def _follows(
    default: float, doc: str, of: str, unit: str = "m", power: int = 1, rule: str = ""
) -> Any:
    meta = {"doc": doc, "of": of, "unit": unit, "power": power, "rule": rule}
    return dataclasses.field(default=default, metadata=meta)


@dataclass(frozen=True)
class Lengths:
    """Each as it is for the vehicle of the defaults, and in proportion to a measure of another.

    Horizontal ones go with the diameter, and heights with `VehicleConfig.least_hazard`: what is
    lower makes no landing fail, and what is as high has to be on the map.
    """

    least_hazard: float = _follows(
        0.3,
        "least height of one thing on level ground that makes the vehicle fail: it rises over the"
        " clearance, or leans the vehicle too far from under one pad",
        "least_hazard",
        rule="min(vehicle.clearance, 0.707 x vehicle.diameter x tan vehicle.max_slope_deg)",
    )

    grid_spacing: float = _follows(0.5, "lss.grid_spacing where it is 0", "diameter")
    min_separation: float = _follows(3.7, "least distance between ranked sites", "diameter")
    max_gap: float = _follows(0.6, "lss.max_gap where it is below 0", "diameter")
    hazard_growth: float = _follows(
        0.25,
        "unsafe ground is extended by this, in whole finest cells, for errors of the map's place",
        "diameter",
    )
    touchdown_slope_deg: float = _follows(
        9.0, "slope limit of the touchdown check on the map", "max_slope_deg", "deg"
    )
    touchdown_roughness: float = _follows(
        0.25, "greatest rise of ground that the touchdown check allows on the map", "clearance"
    )
    reference_size: float = _follows(
        4.0, "about the side of the cells that leaves' elevation is compared with", "diameter"
    )
    outlier_gate: float = _follows(
        0.4,
        "returns farther from all others (and than five times their usual spacing) are noise: a"
        " third more than the top of what must be seen rises over the ground beside it",
        "least_hazard",
    )
    negligible: float = _follows(0.005, "lower tails of a feature are no feature", "least_hazard")
    rock_height: float = _follows(
        0.15, "what stands out so high, and by three range noises, is a rock", "least_hazard"
    )
    rock_sigma: float = _follows(0.5, "a feature of greater sigma divides no leaf", "least_hazard")
    rock_area: float = _follows(
        0.04,
        "what stands out over this area in a view of a part divides a leaf",
        "least_hazard",
        "m^2",
        2,
    )
    tolerance: float = _follows(
        0.3, "a measurement farther from its plane is an exception (Eq. 48)", "least_hazard"
    )
    uneven: float = _follows(
        2.25e-4,
        "variance by which a view of 70 % of a cell's width may lie off its leaf besides; one of"
        " half of it three times as much: ground is no plane",
        "least_hazard",
        "m^2",
        2,
    )
    slack: float = _follows(
        0.01,
        "variance granted before a view contradicts its leaf altogether",
        "least_hazard",
        "m^2",
        2,
    )
    clip: float = _follows(1.0, "residuals count at most this much", "least_hazard")
    feature_height: float = _follows(0.1, "lower features are noise", "least_hazard")
    feature_volume: float = _follows(
        0.002, "features of less volume k^2 are noise", "least_hazard", "m^3", 3
    )


@lru_cache(maxsize=8)
def _lengths(vehicle: VehicleConfig) -> Lengths:
    values = {}
    for item in dataclasses.fields(Lengths):
        share = vehicle._ratio(item.metadata["of"])
        values[item.name] = item.default * share ** item.metadata["power"]
    return Lengths(**values)
