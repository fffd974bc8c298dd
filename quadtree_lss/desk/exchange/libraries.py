# SPDX-License-Identifier: Apache-2.0
"""Libraries that read and write other programs' files; they are large, so nobody must have them."""

from __future__ import annotations

import importlib
from typing import Any

from quadtree_lss.onboard.errors import QuadtreeLssError


class ExchangeError(QuadtreeLssError):
    """A file of another program cannot be read or written."""


def library(name: str, what: str) -> Any:
    """A module of the extra ``exchange``, which ``what`` needs. Raises `ExchangeError`: it is not
    installed; says how to get it."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        lack = (error.name or name).partition(".")[0]
        msg = f"{what} need {lack}, which is not installed: pip install {lack}"
        raise ExchangeError(msg) from None
