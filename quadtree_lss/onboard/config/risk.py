# SPDX-License-Identifier: Apache-2.0
"""What a lander's worst contact with the map says of the true one: fitted, read from a file."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from quadtree_lss.onboard.config.parameter import ConfigError
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.config.yaml_text import MOST_BYTES, YamlError, parse_yaml

SHIPPED = "flash_lidar.yaml"
Row = tuple[float, ...]
#: What a fit was made with may differ from what it is used with by such a share.
NEAR = 0.3


@dataclass(frozen=True)
class RiskModel:
    """Probability that a lander fails, from its worst contact on the map, in two steps.

    First the contact at the place itself. With a and b straight between their knots, r how far the
    ground rises over a resting plane beyond ``lss.max_roughness`` and s how much steeper such a
    plane is than ``lss.max_slope_deg``, it fails with

        p = 1 - 1 / ((1 + exp a(r)) (1 + exp b(s))),    l = log(p / (1 - p)).

    Then what lies about it, for a map misplaces things: d is by how much l is greater at the worst
    of the four neighbours. And what ground it is, for where rocks are seen there are some that are
    not. Of the ground that is judged and on which the lander stands level enough let u be the share
    where something rises under it by more than ``lss.max_roughness``, and v that where it rises by
    more than 0.12 m less. Rocks rise much or not at all, the rims of craters mostly a little:

        g = log(u (u / v)^3 + 0.00003).

    On flat ground what rises is rocks, of which a map shows a part; where the ground undulates it
    is its form as well, which a map shows whole: h is the mean slope of that level ground. The log
    odds of failing are c(g, l, d) + m(h, l, d) + t n(l, d), each straight between its knots, where
    t ascends from 0 to 1 between two deviations of the range noise that the mapping is told.

    Attributes:
        rise: (K,) knots of r, m; rise_odds: (K,) a there.
        slope: (L,) knots of s, rise over run; slope_odds: (L,) b there.
        own: (I,) knots of l; about: (J,) knots of d; rocks: (G,) knots of g; odds: (G, I, J) c
            there.
        undulation: (H,) knots of h, rad; undulating: (H - 1, I, J) m there, but at the first, where
            it is 0.
        noise: (2,) range noise where t is 0 and 1, m; noisy: (I, J) n at the knots of l and d.
        provenance: What it was fitted to, and how well it does.
    """

    rise: Row
    rise_odds: Row
    slope: Row
    slope_odds: Row
    own: Row
    about: Row
    rocks: Row
    odds: tuple[tuple[Row, ...], ...]
    undulation: Row
    undulating: tuple[tuple[Row, ...], ...]
    noise: Row
    noisy: tuple[Row, ...]
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def tables(self) -> tuple[tuple[Row, ...], ...]:
        """(G + H, I, J) all of what the log odds are a weighted sum of: c, m and n."""
        return (*self.odds, *self.undulating, self.noisy)

    def __post_init__(self) -> None:
        for name, knots, values in (
            ("rise", self.rise, self.rise_odds),
            ("slope", self.slope, self.slope_odds),
            *(("own", self.own, table) for table in self.tables),
            ("undulation", self.undulation, (None, *self.undulating)),
            ("noise", self.noise, (0.0, 1.0)),
        ):
            if len(knots) < 2 or len(knots) != len(values):
                msg = f"{name} has {len(knots)} knots and {len(values)} values"
                raise ConfigError(msg)
        rows = [row for table in self.tables for row in table]
        if len(self.about) < 2 or any(len(row) != len(self.about) for row in rows):
            msg = f"odds has not {len(self.about)} values in each row"
            raise ConfigError(msg)
        if not self.rocks or len(self.rocks) != len(self.odds):
            msg = f"rocks has {len(self.rocks)} knots and odds {len(self.odds)} tables"
            raise ConfigError(msg)
        for name in ("rise", "slope", "own", "about", "rocks", "undulation", "noise"):
            knots = getattr(self, name)
            if any(not b > a for a, b in zip(knots, knots[1:], strict=False)):
                msg = f"the knots of {name} do not ascend"
                raise ConfigError(msg)


@functools.lru_cache(maxsize=8)
def risk_model(name: str) -> RiskModel:
    """The model in a file, or for an empty name the one that comes with the package.

    Raises:
        ConfigError: there is no such file, or it holds no model.
    """
    try:
        if name:
            file = Path(name).expanduser()
            with file.open("rb") as stream:
                text = stream.read(MOST_BYTES)
        else:
            text = (resources.files("quadtree_lss.onboard.config") / SHIPPED).read_bytes()
        values = parse_yaml(text.decode())
        return _from_values(values)
    except (OSError, UnicodeDecodeError, YamlError) as error:
        why = getattr(error, "strerror", None) or error
        msg = f"lss.risk_model: cannot read {name or SHIPPED}: {why}"
        raise ConfigError(msg) from error
    except (ConfigError, KeyError, TypeError, ValueError, AttributeError) as error:
        why = f"{error} is missing" if isinstance(error, KeyError) else error
        msg = f"lss.risk_model: {name or SHIPPED} is no risk model: {why}"
        raise ConfigError(msg) from error


def doubt(config: Config) -> str:
    """In which way the model of a configuration was fitted to another vehicle or map; or nothing.

    The provenance of a model says what it was ``fitted`` to, from and to: ``diameter``, m;
    ``clearance`` and ``cell``, diameters; ``noise``, clearances; ``max_slope_deg``. One that says
    the ``lander`` and the ``finest_cell`` alone was fitted to these.

    Raises:
        ConfigError: as of `risk_model`.
    """
    lss, model = config.lss, risk_model(config.lss.risk_model)
    if "probability" not in (lss.assessment, lss.ranking):
        return ""
    vehicle, cell = lss.vehicle, config.domain.size / 2**config.domain.max_level
    used = {
        "diameter": ("a vehicle of {} m", vehicle.diameter, 1.0),
        "clearance": ("a clearance of {} m", vehicle.clearance, vehicle.diameter),
        "max_slope_deg": ("a slope of {} deg", vehicle.max_slope_deg, 1.0),
        "cell": ("cells of {} m", cell, vehicle.diameter),
        "noise": ("a range noise of {} m", config.lidar.range_noise, vehicle.clearance),
    }
    far, fitted = [], model.provenance.get("fitted") or _fitted_one(model, used)
    for name, (text, value, unit) in used.items():
        low, high = (unit * float(of) for of in fitted.get(name) or (value / unit,) * 2)
        if not (1.0 - NEAR) * low <= value <= (1.0 + NEAR) * high:
            given = f"{low:g}" if low == high else f"{low:g} to {high:g}"
            far.append(f"{text.format(given)}, not {value:g}")
    if not far:
        return ""
    name = lss.risk_model or SHIPPED
    return f"the risk model {name} was fitted for {'; '.join(far)}: fit-risk makes another"


def _fitted_one(
    model: RiskModel, used: Mapping[str, tuple[str, float, float]]
) -> dict[str, tuple[float, float]]:
    """The same of one lander, in the units of ``used``."""
    origin = model.provenance
    given = dict(origin.get("lander") or {}) | {"cell": origin.get("finest_cell")}
    given["clearance"] = given.get("max_roughness")
    ones = {name: (value, value) for name, value in given.items() if name in used and value}
    ones["noise"] = model.noise[0], model.noise[-1]
    return {name: (low / used[name][2], high / used[name][2]) for name, (low, high) in ones.items()}


def risk_model_text(model: RiskModel) -> str:
    """The model as `risk_model` reads it."""

    def line(row: Row) -> str:
        return "[" + ", ".join(f"{value:.6g}" for value in row) + "]"

    names = "rise rise_odds slope slope_odds own about rocks undulation noise".split()
    lines = [f"{name}: {line(getattr(model, name))}" for name in names]
    for name in ("odds", "undulating"):
        lines.append(f"{name}:")
        for table in getattr(model, name):
            lines += ["  -", *(f"    - {line(row)}" for row in table)]
    lines += ["noisy:", *(f"  - {line(row)}" for row in model.noisy)]
    origin = {"provenance": dict(model.provenance)}
    told = yaml.safe_dump(origin, sort_keys=False, width=96, default_flow_style=None)
    return "\n".join(lines) + "\n" + str(told)


def _from_values(values: Any) -> RiskModel:
    def row(given: Any) -> Row:
        return tuple(float(value) for value in given)

    def tables(given: Any) -> tuple[tuple[Row, ...], ...]:
        return tuple(tuple(row(line) for line in table) for table in given)

    own, about = row(values["own"]), row(values["about"])
    if "rocks" not in values:  # a file of the first version has one table for all ground
        values = values | {"rocks": [0.0], "odds": [values["odds"]]}
    flat, at = [[0.0] * len(about)] * len(own), [0.0, 1.0]  # and nothing is added to it
    values = {"undulation": at, "undulating": [flat], "noise": at, "noisy": flat} | values
    return RiskModel(
        rise=row(values["rise"]),
        rise_odds=row(values["rise_odds"]),
        slope=row(values["slope"]),
        slope_odds=row(values["slope_odds"]),
        own=own,
        about=about,
        rocks=row(values["rocks"]),
        odds=tables(values["odds"]),
        undulation=row(values["undulation"]),
        undulating=tables(values["undulating"]),
        noise=row(values["noise"]),
        noisy=tables([values["noisy"]])[0],
        provenance=dict(values.get("provenance") or {}),
    )
