# SPDX-License-Identifier: Apache-2.0
"""Risk model: probability of a failed landing from features of the map, read from a file."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
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
LOCAL = tuple("rise rise_beside tilt tilt_beside seen gradient roughness relief abundance".split())
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

    ``docs/probability.md`` defines the features, which are dimensionless: ``seen`` is its k, and
    ``rise_beside`` and ``tilt_beside`` are maxima of the grid point and its four neighbours.

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


@functools.lru_cache(maxsize=8)
def risk_model(name: str) -> RiskModel:
    """Read a model from a file, or the package's for an empty name. Raises `ConfigError` if there
    is no such file, or it is not a risk model."""
    file = Path(name).expanduser() if name else Path(__file__).with_name(DEFAULT_MODEL)
    try:
        return _from_values(read_yaml(file))
    except YamlError as error:
        raise ConfigError(f"lss.risk_model: {name or DEFAULT_MODEL} {error}") from error
    except (ConfigError, KeyError, TypeError, ValueError, AttributeError) as error:
        why = f"{error} is missing" if isinstance(error, KeyError) else error
        msg = f"lss.risk_model: {name or DEFAULT_MODEL} is not a risk model: {why}"
        raise ConfigError(msg) from error


def model_warning(config: Config) -> str:
    """Return a warning if the risk model was fitted to another kind of vehicle or map, or "", by
    the ranges ``fitted`` of its provenance. Raises as `risk_model`."""
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
    """Read a model. Raises `ConfigError`, `KeyError`, `TypeError`, `ValueError`,
    `AttributeError`."""
    seen, causes = _ascending("seen", values["seen"]), {}
    for name in CAUSES:
        given = dict(values[name])
        (constant,) = _row(f"{name}: constant", [given.pop("constant")])
        curves = (_curve(f"{name}: {of}", of, curve, seen) for of, curve in given.items())
        causes[name] = Cause(constant, tuple(curves))
    return RiskModel(seen, causes, dict(values.get("provenance") or {}))


def _curve(what: str, feature: str, given: Any, seen: Row) -> Curve:
    if feature not in LOCAL + OVERALL:
        raise ConfigError(f"{what} is not known: fit-risk makes a new model")
    knots = _ascending(what, given["knots"])
    odds = tuple(_row(what, row) for row in given["odds"])
    rows = {1} if feature in ("seen", *OVERALL) else {1, len(seen)}
    if len(odds) not in rows or any(len(row) != len(knots) for row in odds):
        wanted = " or ".join(map(str, sorted(rows)))
        raise ConfigError(f"{what} needs {wanted} rows of odds, one for each knot")
    return Curve(feature, knots, odds)


def _ascending(what: str, values: Any) -> Row:
    row = _row(what, values)
    if len(row) < 2 or not (np.diff(row) > 0.0).all():
        raise ConfigError(f"the knots of {what} do not ascend")
    return row


def _row(what: str, values: Any) -> Row:
    row = tuple(float(value) for value in values)
    if not np.isfinite(row).all():
        raise ConfigError(f"{what} has numbers that are not finite")
    return row
