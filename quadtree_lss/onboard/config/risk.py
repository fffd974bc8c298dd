# SPDX-License-Identifier: Apache-2.0
"""Risk model: probability of a failed landing from features of the map, read from a file."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from quadtree_lss.onboard.config.parameter import ConfigError
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.config.yaml_text import YamlError, read_yaml

DEFAULT_MODEL = "flash_lidar.yaml"
Row = tuple[float, ...]
#: Relative difference from the values of the fit at which a model may be used without a warning.
FIT_TOLERANCE = 0.3

#: Causes of failed landings: an obstacle under the lander, slope, and an obstacle that is not on
#: the map.
CAUSES = ("obstacle", "slope", "hidden")
#: Features of a grid point, and of the map as a whole (see `RiskModel`).
LOCAL = (
    "rise",
    "rise_beside",
    "tilt",
    "tilt_beside",
    "seen",
    "gradient",
    "roughness",
    "relief",
    "abundance",
)
OVERALL = ("noise", "cell", "clearance", "lean")


@dataclass(frozen=True)
class Curve:
    """Log odds as a function of one feature, linear between knots and constant beyond them.

    Attributes:
        feature: A name of `LOCAL` or `OVERALL`.
        knots: (K,) values of the feature.
        odds: (1, K) log odds; or, for local features other than ``seen``, (S, K), one row for each
            knot of ``seen``.
    """

    feature: str
    knots: Row
    odds: tuple[Row, ...]


@dataclass(frozen=True)
class Cause:
    """Log odds of failure by one of `CAUSES`: a constant plus the sum of curves."""

    constant: float
    curves: tuple[Curve, ...]

    def map_log_odds(self, overall: Mapping[str, float]) -> float:
        """Return the constant plus the curves of the map's features ``overall``."""
        return self.constant + sum(
            float(np.interp(overall[curve.feature], curve.knots, curve.odds[0]))
            for curve in self.curves
            if curve.feature in OVERALL
        )


@dataclass(frozen=True)
class RiskModel:
    """Probability that a landing at a grid point fails, by independent causes:

        P(unsafe) = 1 - product over `CAUSES` of 1 / (1 + exp z),    z = constant + sum of curves.

    All features are dimensionless. With c the clearance, d the diameter and h the least hazard of
    the vehicle (`VehicleConfig.least_hazard`), in squares about the grid point:

    - ``rise``: rise of the ground over the worst contact plane on the map, over c; ``tilt``:
      tangent of the steepest contact plane's slope over that of the limit; ``rise_beside``,
      ``tilt_beside``: maximum of the grid point and its four neighbours.
    - ``seen``: k, density of observation under the lander (0.9 d): mean of log10 of the independent
      returns on a square of side h (mean of 3 x 3 finest cells), minus 2 log10(noise / 0.2 h), and
      minus 3 log10(cell / 0.85 h) for cells wider than 0.85 h. It is thus the number of returns
      with the same information at a range noise of 0.2 h. Cells without a return count 0.001.
    - ``gradient``: tangent of the ground's slope at the lander's scale over that of the limit.
    - ``roughness``: square root of the mean misfit of the leaves' planes under the lander over c;
      ``relief``: root mean square there of the rise of the map's cells over the ground at the
      lander's scale, over c (cells below it count 0).
    - ``abundance``: log10 of the fraction of well observed ground, in a square of 8 d, with objects
      that rise by 0.5 to 1 c over the ground at the lander's scale. Where many are observed, more
      are hidden.
    - ``noise``, ``cell``, ``clearance``, ``lean``: log10 of noise / c, of finest cell / c, of
      c / d, and of `VehicleConfig.tilt_height` / c.

    Attributes:
        seen: (S,) knots of k between which the rows of a curve's odds are interpolated.
        causes: `Cause` by name.
        provenance: Data and scores of the fit.
    """

    seen: Row
    causes: Mapping[str, Cause]
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def span(self, name: str) -> tuple[float, float]:
        """Return the lowest and highest knot of a feature."""
        curves = [curve for cause in self.causes.values() for curve in cause.curves]
        ends = [end for curve in curves if curve.feature == name for end in curve.knots]
        ends += self.seen if name == "seen" else ()
        return (min(ends), max(ends)) if ends else (0.0, 1.0)

    def __post_init__(self) -> None:
        if tuple(self.causes) != CAUSES:
            msg = f"its causes are {', '.join(self.causes)}, not {', '.join(CAUSES)}"
            raise ConfigError(msg)
        for name, cause in self.causes.items():
            numbers = chain(*(row for curve in cause.curves for row in (curve.knots, *curve.odds)))
            if not np.isfinite([cause.constant, *numbers]).all():
                msg = f"{name} has numbers that are not finite"
                raise ConfigError(msg)
            for curve in cause.curves:
                what = f"{name}: {curve.feature}"
                if curve.feature not in LOCAL + OVERALL:
                    msg = f"{what} is not known"
                    raise ConfigError(msg)
                count = len(curve.knots)
                if count < 2 or any(len(row) != count for row in curve.odds):
                    msg = f"{what} has {count} knots and other odds"
                    raise ConfigError(msg)
                rows = {1} if curve.feature in ("seen", *OVERALL) else {1, len(self.seen)}
                if len(curve.odds) not in rows:
                    wanted = " or ".join(map(str, sorted(rows)))
                    msg = f"{what} has {len(curve.odds)} rows of odds, not {wanted}"
                    raise ConfigError(msg)
                if not (np.diff(curve.knots) > 0.0).all() or not (np.diff(self.seen) > 0.0).all():
                    msg = f"the knots of {what} do not ascend"
                    raise ConfigError(msg)


@functools.lru_cache(maxsize=8)
def risk_model(name: str) -> RiskModel:
    """Read a model from a file, or the package's for an empty name. Raises `ConfigError` if there
    is no such file, or it is not a risk model."""
    file = Path(name).expanduser() if name else Path(__file__).with_name(DEFAULT_MODEL)
    try:
        return _from_values(read_yaml(file))
    except YamlError as error:
        msg = f"lss.risk_model: {name or DEFAULT_MODEL} {error}"
        raise ConfigError(msg) from error
    except (ConfigError, KeyError, TypeError, ValueError, AttributeError) as error:
        why = f"{error} is missing" if isinstance(error, KeyError) else error
        msg = f"lss.risk_model: {name or DEFAULT_MODEL} is not a risk model: {why}"
        raise ConfigError(msg) from error


def model_warning(config: Config) -> str:
    """Return a warning if the risk model was fitted to another kind of vehicle or map, or "".

    The provenance of a model gives the ranges that it was ``fitted`` to: ``diameter``, m;
    ``clearance`` and ``cell``, diameters; ``noise``, clearances; ``max_slope_deg``. Raises as
    `risk_model`.
    """
    lss, model = config.lss, risk_model(config.lss.risk_model)
    if lss.ranking != "probability":
        return ""
    vehicle, cell = lss.vehicle, config.domain.size / 2**config.domain.max_level
    used = {
        "diameter": ("a vehicle of {} m", vehicle.diameter, 1.0),
        "clearance": ("a clearance of {} m", vehicle.clearance, vehicle.diameter),
        "max_slope_deg": ("a slope of {} deg", vehicle.max_slope_deg, 1.0),
        "cell": ("cells of {} m", cell, vehicle.diameter),
        "noise": ("a range noise of {} m", config.lidar.range_noise, vehicle.clearance),
    }
    far, fitted = [], model.provenance.get("fitted") or {}
    for name, (text, value, unit) in used.items():
        low, high = (unit * float(of) for of in fitted.get(name) or (value / unit,) * 2)
        if not (1.0 - FIT_TOLERANCE) * low <= value <= (1.0 + FIT_TOLERANCE) * high:
            given = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
            far.append(f"{text.format(given)}, not {value:.4g}")
    noise, stereo = config.lidar.range_noise, config.lidar.stereo_noise * config.lidar.max_range**2
    if np.hypot(noise, stereo) > (1.0 + FIT_TOLERANCE) * noise:
        far.append(f"a noise of {noise:g} m at any range, not one that grows to {stereo:.2g}")
    if not far:
        return ""
    name = lss.risk_model or DEFAULT_MODEL
    return f"the risk model {name} was fitted for {'; '.join(far)}: fit-risk makes another"


def _from_values(values: Any) -> RiskModel:
    def row(given: Any) -> Row:
        return tuple(float(value) for value in given)

    if "rocks" in values["hidden"]:
        msg = "it is of a version with other features: fit-risk makes a new one"
        raise ConfigError(msg)
    causes = {}
    for name in CAUSES:
        given = dict(values[name])
        constant = float(given.pop("constant"))
        curves = (
            Curve(of, row(curve["knots"]), tuple(row(line) for line in curve["odds"]))
            for of, curve in given.items()
        )
        causes[name] = Cause(constant, tuple(curves))
    return RiskModel(row(values["seen"]), causes, dict(values.get("provenance") or {}))
