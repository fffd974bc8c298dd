# SPDX-License-Identifier: Apache-2.0
"""One row of the table of parameters: how it is declared and what values it takes."""

from __future__ import annotations

import functools
import math
import numbers
import typing
from collections.abc import Sequence
from dataclasses import dataclass, field

from quadtree_lss.onboard.errors import QuadtreeLssError

Value = bool | int | float | str


class ConfigError(QuadtreeLssError):
    """A configuration value or key is wrong; names the key and what is allowed."""


@dataclass(frozen=True)
class Parameter:
    """One row of the table: the dotted name; the unit, empty for none; the inclusive range of
    numbers; allowed texts, empty for any; whether a running node accepts a change."""

    name: str
    type: type
    default: Value
    unit: str
    low: float
    high: float
    choices: tuple[str, ...]
    live: bool
    doc: str


def declared(
    default: typing.Any,
    doc: str,
    limits: tuple[float, float] = (-math.inf, math.inf),
    unit: str = "",
    *,
    choices: Sequence[str] = (),
    live: bool = False,
) -> typing.Any:
    """A dataclass field that is a row of the table; see `Parameter` for the arguments."""
    low, high = limits
    meta = {"low": low, "high": high, "choices": tuple(choices), "live": live}
    return field(default=default, metadata={"doc": doc, "unit": unit, **meta})


#: The same of a parameter that a running node accepts.
live = functools.partial(declared, live=True)


def checked_value(row: Parameter, value: object) -> Value:
    """``value`` converted to the row's type. Raises `ConfigError`: wrong type, out of range, not
    finite or not among the choices."""
    if value is False and "none" in row.choices:  # what YAML makes of `off`
        value = "none"
    kinds = {bool: bool, str: str, int: numbers.Integral, float: numbers.Real}
    if not isinstance(value, kinds[row.type]) or (row.type is not bool and isinstance(value, bool)):
        msg = f"{row.name} must be {row.type.__name__}, got {value!r}"
        raise ConfigError(msg)
    if row.type in (int, float) and not row.low <= value <= row.high:  # type: ignore[operator]
        unit = f" {row.unit}" if row.unit else ""
        msg = f"{row.name} = {value} is outside [{row.low:g}, {row.high:g}]{unit}"
        raise ConfigError(msg)
    checked = row.type(value)
    if row.choices and checked not in row.choices:
        msg = f"{row.name} = {checked!r} is not one of {', '.join(row.choices)}"
        raise ConfigError(msg)
    return checked  # type: ignore[no-any-return]
