# SPDX-License-Identifier: Apache-2.0
"""Tables of a results folder, which are CSV files, read back."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.desk.exchange.cells import unreadable

Table = dict[str, NDArray[Any]]
"""Columns of a CSV file by name: whole numbers, numbers, or else texts."""


def read_table(path: Path) -> Table:
    """The columns of a file. Raises `ResultsError`: it is no table."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = list(csv.reader(file)) or [[]]
    except (OSError, ValueError, csv.Error) as error:
        raise unreadable(path, error) from None
    if any(len(row) != len(header) for row in rows):
        raise unreadable(path, "its rows differ in length")
    return {name: _column([row[k] for row in rows]) for k, name in enumerate(header)}


def _column(texts: list[str]) -> NDArray[Any]:
    for kind in (np.int64, np.float64):
        try:
            return np.array([int(t) if kind is np.int64 else float(t) for t in texts], dtype=kind)
        except (ValueError, OverflowError):
            continue
    return np.array(texts)
