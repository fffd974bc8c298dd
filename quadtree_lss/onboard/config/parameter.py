# SPDX-License-Identifier: Apache-2.0
"""One row of the table of parameters: how it is declared and what values it takes."""

from __future__ import annotations

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
    """One row of the table.

    Attributes:
        name: Dotted name, for instance ``domain.min_level``.
        type: ``bool``, ``int``, ``float`` or ``str``.
        default: Value used when none is given.
        unit: Unit of the value, empty for none.
        low, high: Inclusive range of numbers.
        choices: Allowed texts, empty for any.
        live: True if a running node accepts a change.
        doc: What it does.
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
    *,
    unit: str = "",
    low: float = -math.inf,
    high: float = math.inf,
    choices: Sequence[str] = (),
    live: bool = False,
) -> typing.Any:
    """A dataclass field that is a row of the table; see `Parameter` for the arguments."""
    metadata = {
        "doc": doc,
        "unit": unit,
        "low": low,
        "high": high,
        "choices": tuple(choices),
        "live": live,
    }
    return field(default=default, metadata=metadata)


def checked_value(row: Parameter, value: object) -> Value:
    """``value`` converted to the row's type.

    Raises:
        ConfigError: wrong type, out of range, not finite or not among the choices.
    """
    kind = row.type
    fits = {
        bool: isinstance(value, bool),
        str: isinstance(value, str),
        int: isinstance(value, numbers.Integral) and not isinstance(value, bool),
        float: isinstance(value, numbers.Real) and not isinstance(value, bool),
    }
    if fits[kind]:
        value = kind(value)
    else:
        msg = f"{row.name} must be {kind.__name__}, got {value!r}"
        raise ConfigError(msg)
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        if not math.isfinite(value) or not row.low <= value <= row.high:
            unit = f" {row.unit}" if row.unit else ""
            msg = f"{row.name} = {value} is outside [{row.low:g}, {row.high:g}]{unit}"
            raise ConfigError(msg)
    if row.choices and value not in row.choices:
        msg = f"{row.name} = {value!r} is not one of {', '.join(row.choices)}"
        raise ConfigError(msg)
    return value  # type: ignore[return-value]
