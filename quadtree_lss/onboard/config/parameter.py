# SPDX-License-Identifier: Apache-2.0
"""Declaration of a parameter, and check of its values."""

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
    """A configuration key or value is wrong; the text names the key and the allowed values."""


@dataclass(frozen=True)
class Parameter:
    """A row of the table of parameters.

    Attributes:
        name: Dotted name.
        unit: Empty for none.
        low, high: Inclusive range of a number.
        choices: Allowed texts; empty for any.
        live: A running node accepts a change.
        doc: Meaning, for documents and ``ros2 param describe``.
    """

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
    """Declare a dataclass field as a row of the table; arguments as for `Parameter`."""
    low, high = limits
    meta = {"low": low, "high": high, "choices": tuple(choices), "live": live}
    return field(default=default, metadata={"doc": doc, "unit": unit, **meta})


#: Declare a parameter that a running node accepts.
live = functools.partial(declared, live=True)


def checked_value(row: Parameter, value: object) -> Value:
    """Convert a value to the row's type. Raises `ConfigError` if it has the wrong type, is out of
    range, not finite or not among the choices."""
    if value is False and "none" in row.choices:  # YAML reads `off` as False
        value = "none"
    kinds = {bool: bool, str: str, int: numbers.Integral, float: numbers.Real}
    if not isinstance(value, kinds[row.type]) or (row.type is not bool and isinstance(value, bool)):
        raise ConfigError(f"{row.name} must be {row.type.__name__}, got {value!r}")
    if row.type in (int, float) and not row.low <= value <= row.high:  # type: ignore[operator]
        unit = f" {row.unit}" if row.unit else ""
        raise ConfigError(f"{row.name} = {value} is outside [{row.low:g}, {row.high:g}]{unit}")
    checked = row.type(value)
    if row.choices and checked not in row.choices:
        raise ConfigError(f"{row.name} = {checked!r} is not one of {', '.join(row.choices)}")
    return checked  # type: ignore[no-any-return]
