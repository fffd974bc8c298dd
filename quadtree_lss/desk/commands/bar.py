# SPDX-License-Identifier: Apache-2.0
"""The bar of `console.ProgressBar`."""

from __future__ import annotations

import sys
from typing import Any

from tqdm import tqdm

_BAR = "{desc} {percentage:3.0f} % |{bar}| {n:.0f} of {total:.0f} {unit}, {speed}, {remaining} left"


class Bar(tqdm):  # type: ignore[type-arg]
    """Tells its speed in words."""

    @classmethod
    def of(cls, what: str, unit: str) -> Bar:
        """One on stderr, gone when it is closed; see `console.ProgressBar`."""
        # Until it is told of how much: a total of None cannot be formatted.
        return cls(desc=what, unit=unit, total=1, file=sys.stderr, leave=False, bar_format=_BAR)

    @property
    def format_dict(self) -> dict[str, Any]:
        """As in the base class, with ``speed``."""
        told = super().format_dict
        rate, unit = told["rate"], told["unit"]
        if rate is None and told["elapsed"] > 0.0:
            rate = told["n"] / told["elapsed"]
        number = "?" if not rate else f"{rate:.{0 if rate >= 100.0 else 1}f}"
        told["speed"] = f"{number} x real time" if unit == "s" else f"{number} {unit}/s"
        return told
