# SPDX-License-Identifier: Apache-2.0
"""Optional libraries for the file formats of other programs."""

from __future__ import annotations

import importlib
from typing import Any

from quadtree_lss.onboard.errors import QuadtreeLssError


class ExchangeError(QuadtreeLssError):
    """A file cannot be read or written."""


def library(name: str, what: str) -> Any:
    """Import a module of the extra ``exchange``, which ``what`` needs. Raises `ExchangeError`: it
    is not installed."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing = (error.name or name).partition(".")[0]
        msg = f"{what} need {missing}, which is not installed: pip install {missing}"
        raise ExchangeError(msg) from None
