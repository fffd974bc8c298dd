# SPDX-License-Identifier: Apache-2.0
"""The vehicle and the lengths derived from it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from math import radians, sqrt, tan
from typing import Any

from quadtree_lss.onboard.config.parameter import declared, live


@dataclass(frozen=True)
class VehicleConfig:
    """The vehicle; the lengths of mapping and landing are derived from it."""

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
        """Diameter over that of the default vehicle, for which the constants were tuned."""
        return self._ratio("diameter")

    @property
    def clearance_ratio(self) -> float:
        """Clearance over that of the default vehicle."""
        return self._ratio("clearance")

    @property
    def tilt_height(self) -> float:
        """Height under one of four pads on level ground at which the tilt reaches the limit, m.

        With one pad at height h, the opposite pad and a third one touch the ground. The contact
        plane falls by h / D along that diagonal, where D is the diameter, and by h / D across it:
        the slope is sqrt(2) h / D.
        """
        return self.diameter * tan(radians(self.max_slope_deg)) / sqrt(2.0)

    @property
    def ground_radius(self) -> float:
        """Radius of the disc for the ground plane at the vehicle's scale, three quarters of the
        vehicle's radius, m."""
        return 0.75 * 0.5 * self.diameter

    @property
    def least_hazard(self) -> float:
        """Smallest height of an object on level ground that makes a landing fail, m: it exceeds
        the clearance, or tilts the vehicle too far."""
        return min(self.clearance, self.tilt_height)

    @cached_property
    def lengths(self) -> Lengths:
        """The lengths derived from the vehicle."""
        values = {}
        for item in dataclasses.fields(Lengths):
            ratio = self._ratio(item.metadata["of"])
            values[item.name] = item.default * ratio ** item.metadata["power"]
        return Lengths(**values)

    def _ratio(self, name: str) -> float:
        """Return an attribute over that of the default vehicle, exactly 1 for the defaults."""
        return float(getattr(self, name) / getattr(_DEFAULT, name))


_DEFAULT = VehicleConfig()


def _derived(
    default: float, doc: str, of: str, unit: str = "m", power: int = 1, rule: str = ""
) -> Any:
    meta = {"doc": doc, "of": of, "unit": unit, "power": power, "rule": rule}
    return dataclasses.field(default=default, metadata=meta)


@dataclass(frozen=True)
class Lengths:
    """Lengths derived from the vehicle. The defaults hold for the default vehicle.

    Horizontal lengths are proportional to the diameter and heights to `VehicleConfig.least_hazard`,
    the smallest height that the map has to show.
    """

    least_hazard: float = _derived(
        0.3,
        "least height of a single object on level ground that makes a landing fail: it exceeds the"
        " clearance, or tilts the vehicle too far if one pad stands on it",
        "least_hazard",
        rule="min(vehicle.clearance, 0.707 x vehicle.diameter x tan vehicle.max_slope_deg)",
    )

    grid_spacing: float = _derived(0.5, "lss.grid_spacing where it is 0", "diameter")
    min_separation: float = _derived(3.7, "least distance between ranked sites", "diameter")
    max_gap: float = _derived(0.6, "lss.max_gap where it is below 0", "diameter")
    hazard_growth: float = _derived(
        0.25,
        "unsafe ground is extended by this, in whole finest cells, for position errors of the map",
        "diameter",
    )
    touchdown_slope_deg: float = _derived(
        9.0, "slope limit of the touchdown check on the map", "max_slope_deg", "deg"
    )
    touchdown_roughness: float = _derived(
        0.25, "greatest rise of ground that the touchdown check allows on the map", "clearance"
    )
    reference_size: float = _derived(
        4.0,
        "approximate side of the ancestor that the elevation of a leaf is compared with",
        "diameter",
    )
    outlier_gate: float = _derived(
        0.4,
        "returns farther than this from all others, and farther than five times the usual spacing,"
        " are noise",
        "least_hazard",
    )
    negligible: float = _derived(
        0.005, "a feature lower than this is ignored at a grid point", "least_hazard"
    )
    rock_height: float = _derived(
        0.15, "height over the plane, and at least three range noises, of a rock", "least_hazard"
    )
    rock_sigma: float = _derived(
        0.5, "features with a larger sigma do not divide a leaf", "least_hazard"
    )
    rock_area: float = _derived(
        0.04,
        "area of points off the plane that divides a partly viewed leaf",
        "least_hazard",
        "m^2",
        2,
    )
    tolerance: float = _derived(
        0.3, "a return farther from its plane is an exception (Eq. 48)", "least_hazard"
    )
    uneven: float = _derived(
        2.25e-4,
        "additional variance between leaf and a view of 70 % of its width, because ground is not"
        " plane; three times as much for a view of half",
        "least_hazard",
        "m^2",
        2,
    )
    slack: float = _derived(
        0.01, "additional variance before a view contradicts its leaf", "least_hazard", "m^2", 2
    )
    clip: float = _derived(1.0, "larger residuals are limited to this value", "least_hazard")
    feature_height: float = _derived(0.1, "lower features are noise", "least_hazard")
    feature_volume: float = _derived(
        0.002, "features with a smaller volume k^2 are noise", "least_hazard", "m^3", 3
    )
