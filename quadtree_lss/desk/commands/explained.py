# SPDX-License-Identifier: Apache-2.0
"""Parameters for people: what is wrong with a file, what a key means."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterable
from types import SimpleNamespace

from quadtree_lss.desk.replay.configuration import find_config, scalar_text
from quadtree_lss.onboard.config.loading import check_reaches, read_values
from quadtree_lss.onboard.config.settings import (
    Config,
    ConfigError,
    Parameter,
    checked_values,
    contradictions,
    parameters,
    unknown_parameter,
)
from quadtree_lss.onboard.config.vehicle import Lengths, VehicleConfig


def check_files(paths: Iterable[str | os.PathLike[str]], node: str = "") -> dict[str, list[str]]:
    """Each file by itself over the defaults: all that is wrong with it, a line each. ``node``: full
    name of a node that is to get something of each."""
    return {str(path): _errors_of(path, node) for path in paths}


def _errors_of(path: str | os.PathLike[str], node: str) -> list[str]:
    errors: list[str] = []
    try:
        found = find_config(path)
        if node:
            check_reaches(found, node)
        values = read_values(found, errors)
    except ConfigError as error:
        return [str(error).removeprefix(f"{path}: ")]
    sound = checked_values(values, errors)
    sections = {
        item.name: dataclasses.replace(getattr(Config(), item.name), **sound.get(item.name, {}))
        for item in dataclasses.fields(Config)
    }
    return errors + list(contradictions(SimpleNamespace(**sections)))


def explain(name: str) -> list[Parameter]:
    """The parameter of that name, or all of the section of that name. Raises `ConfigError`: there
    is none; names the nearest."""
    table = parameters()
    rows = [row for row in table if row.name == name or row.name.startswith(f"{name}.")]
    if not rows:
        sections = sorted({row.name.partition(".")[0] for row in table})
        raise ConfigError(f"{unknown_parameter(name)} (sections: {', '.join(sections)})")
    return rows


def explain_text(row: Parameter) -> str:
    unit = f" {row.unit}" if row.unit else ""
    lines = [f"{row.name} ({row.type.__name__})", f"  {row.doc}"]
    lines.append(f"  default  {scalar_text(row.default)}{unit}")
    name = row.name.removeprefix("lss.")
    if name in Lengths.__dataclass_fields__:
        lines[-1] += f": {rule(name)}, {getattr(Lengths(), name):g}{unit} of the default vehicle"
    if row.choices:
        lines.append(f"  choices  {', '.join(row.choices)}")
    elif row.type in (int, float):
        lines.append(f"  range    {row.low:g} .. {row.high:g}{unit}")
    lines.append(f"  running  {'may be set on a running node' if row.live else 'read at start'}")
    return "\n".join(lines)


def lengths_text(vehicle: VehicleConfig) -> str:
    """What follows from a vehicle, value and rule of each, a line each."""
    of = f"{vehicle.diameter:g} m that clears {vehicle.clearance:g} m"
    lines = [f"what follows from a vehicle of {of}:"]
    for item in dataclasses.fields(Lengths):
        value = f"{getattr(vehicle.lengths, item.name):.4g} {item.metadata['unit']}"
        text = f"{rule(item.name)}: {item.metadata['doc']}"
        lines.append(f"  {item.name:<20} {value:<12} = {text}")
    return "\n".join(lines)


def parameter_as_dict(row: Parameter) -> dict[str, object]:
    """One parameter in JSON's types; limits that are infinite are None."""
    numeric = row.type in (int, float)
    return {
        "type": row.type.__name__,
        "default": row.default,
        "unit": row.unit,
        "low": row.low if numeric and math.isfinite(row.low) else None,
        "high": row.high if numeric and math.isfinite(row.high) else None,
        "choices": list(row.choices),
        "live": row.live,
        "doc": row.doc,
    }


def rule(name: str) -> str:
    """How a length follows: ``0.833 x vehicle.clearance``, ``0.5 x least_hazard``."""
    item = Lengths.__dataclass_fields__[name]
    if item.metadata["rule"]:
        return str(item.metadata["rule"])
    of, power = item.metadata["of"], item.metadata["power"]
    share = item.default / getattr(VehicleConfig(), of) ** power
    given = of if of in Lengths.__dataclass_fields__ else f"vehicle.{of}"
    return f"{share:.3g} x {given}" + (f"^{power}" if power > 1 else "")
