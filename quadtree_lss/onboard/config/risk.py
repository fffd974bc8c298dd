# SPDX-License-Identifier: Apache-2.0
"""What a lander's worst contact with the map says of the true one: fitted, read from a file."""

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
#: What a fit was made with may differ from what it is used with by such a share.
FIT_TOLERANCE = 0.3


#: Why a landing fails: on something that rises under the lander, on ground too steep, and on what
#: the map does not show at all.
CAUSES = ("obstacle", "slope", "hidden")
#: What a model may ask of each place, and of a map as a whole (see `RiskModel`).
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
    """Log odds by something that is asked, in `LOCAL` or `OVERALL`, straight between knots (K,) and
    level beyond them: (1, K), or of what is asked of places, ``seen`` aside, (S, K), a row for each
    knot of what is seen."""

    of: str
    knots: Row
    odds: tuple[Row, ...]


@dataclass(frozen=True)
class Cause:
    """Log odds of failing for one of `CAUSES`: a constant and the sum of curves."""

    constant: float
    curves: tuple[Curve, ...]

    def map_log_odds(self, overall: Mapping[str, float]) -> float:
        """The constant, and the curves of what is the same all over the map."""
        return self.constant + sum(
            float(np.interp(overall[curve.feature], curve.knots, curve.odds[0]))
            for curve in self.curves
            if curve.feature in OVERALL
        )


@dataclass(frozen=True)
class RiskModel:
    """Probability that a lander fails at a place of a map.

    It stands if nothing that the map shows is in its way, if that is not too steep, and if nothing
    is there that the map does not show:

        P(unsafe) = 1 - product over `CAUSES` of 1 / (1 + exp z),    z = constant + sum of curves.

    All that the curves go by is without a unit. With c the clearance, d the diameter and h the
    least hazard of the vehicle (`VehicleConfig.least_hazard`), in squares about the place:

    - ``rise``: how far ground rises over the worst resting plane on the map, over c; ``tilt``: the
      tangent of the steepest one's slope over that of the limit; ``rise_beside``,
      ``tilt_beside``: the greatest of the place and its four neighbours.
    - ``seen``: k, how well the ground under the lander (0.9 d) is known: the mean of log10 of the
      independent returns on a square as wide as h (mean of 3 x 3 finest cells), in the returns that
      would tell as much at a range noise of 0.2 h and cells of 0.85 h: less 2 log10(noise / 0.2 h),
      and for wider cells 3 log10(cell / 0.85 h). Ground without a return counts 0.001.
    - ``gradient``: the tangent of the ground's slope at the lander's scale over that of the limit.
    - ``roughness``: square root of the mean deviation from the leaves' planes under the lander
      over c; ``relief``: the root mean square there of how far the map's cells rise over the
      ground at the lander's scale, over c (those below it count 0).
    - ``abundance``: log10 of the share of the well observed ground, in a square of 8 d, where
      things are that rise by 0.5 to 1 c over the ground at the lander's scale. Where many of these
      are seen, more are hidden.
    - ``noise``, ``cell``, ``clearance``: log10 of noise / c, of finest cells / c, of c / d;
      ``lean``: of the height under one pad that leans the vehicle too far, over c.

    Attributes:
        seen: (S,) knots of k between which the rows of a curve's odds are interpolated.
        causes: By name.
        provenance: What it was fitted to, and how well it does.
    """

    seen: Row
    causes: Mapping[str, Cause]
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def span(self, name: str) -> tuple[float, float]:
        """Between which values of something that is asked the odds differ."""
        curves = [curve for cause in self.causes.values() for curve in cause.curves]
        ends = [end for curve in curves if curve.feature == name for end in curve.knots]
        ends += self.seen if name == "seen" else ()
        return (min(ends), max(ends)) if ends else (0.0, 1.0)

    @property
    def numbers(self) -> int:
        """Log odds that were fitted."""
        return sum(
            1 + sum(len(row) for curve in cause.curves for row in curve.odds)
            for cause in self.causes.values()
        )

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
    """The model in a file, or for an empty name the one that comes with the package. Raises
    `ConfigError`: there is no such file, or it holds no model."""
    file = Path(name).expanduser() if name else Path(__file__).with_name(DEFAULT_MODEL)
    try:
        return _from_values(read_yaml(file))
    except YamlError as error:
        msg = f"lss.risk_model: {name or DEFAULT_MODEL} {error}"
        raise ConfigError(msg) from error
    except (ConfigError, KeyError, TypeError, ValueError, AttributeError) as error:
        why = f"{error} is missing" if isinstance(error, KeyError) else error
        msg = f"lss.risk_model: {name or DEFAULT_MODEL} is no risk model: {why}"
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
        msg = "it is of a former version, which asked something else: fit-risk makes one anew"
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
