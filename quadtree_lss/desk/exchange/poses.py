# SPDX-License-Identifier: Apache-2.0
"""Poses in text files: TUM's form, or CSV with a header."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.elevation.libraries import ExchangeError

TUM = ("stamp", "x", "y", "z", "qx", "qy", "qz", "qw")
COVARIANCE = tuple(f"cov_{k}" for k in range(36))


@dataclass(frozen=True)
class PoseTable:
    """Poses of the lidar in the map frame, in the order of their stamps.

    Attributes:
        stamp_ns: (K,).
        position: (K, 3) m.
        xyzw: (K, 4) quaternions that take lidar axes to the map.
        covariance: (K, 36) of x, y, z and rotations about the map's axes, row by row; zeros where
            it is not known.
    """

    stamp_ns: NDArray[np.int64]
    position: NDArray[np.float64]
    xyzw: NDArray[np.float64]
    covariance: NDArray[np.float64]


def read_poses(path: Path) -> PoseTable:
    """Poses of a file.

    TUM: lines ``stamp x y z qx qy qz qw`` in s and m, ``#`` begins a comment. CSV: a header with
    ``stamp_ns`` (or ``stamp`` in s) and the other names of TUM, in any order, and perhaps ``cov_0``
    … ``cov_35``; further columns do not matter.

    Raises:
        ExchangeError: the file cannot be read, or is neither.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        msg = f"{path}: cannot be read: {getattr(error, 'strerror', None) or 'it is not text'}"
        raise ExchangeError(msg) from None
    lines = [line for line in text.splitlines() if line.strip() and line.lstrip()[0] != "#"]
    comma = bool(lines) and "," in lines[0]
    rows = list(csv.reader(lines)) if comma else [line.split() for line in lines]
    header = list(TUM)
    if rows and not re.match(r"\s*[-+]?\.?\d", rows[0][0]):
        header = [name.strip() for name in rows.pop(0)]
    clock = "stamp_ns" if "stamp_ns" in header else "stamp"
    lack = [name for name in TUM[1:] if name not in header]
    if lack or clock not in header:
        lack = lack or ["stamp_ns"]
        msg = f"{path}: lacks {', '.join(lack)}: poses are lines of TUM ({' '.join(TUM)}) or CSV"
        raise ExchangeError(msg)
    if not rows:
        raise ExchangeError(f"{path}: there is no pose in it")
    stamps, values = [], []
    known_covariance = set(COVARIANCE) <= set(header)
    for number, row in enumerate(rows, start=1):
        cells = dict(zip(header, row, strict=False))
        try:
            exact = Decimal(cells[clock].strip())
            stamps.append(np.int64(int(exact if clock == "stamp_ns" else exact * 10**9)))
            wanted = (*TUM[1:], *COVARIANCE[: 36 * known_covariance])
            values.append([float(cells[name]) for name in wanted])
        except (ValueError, KeyError, ArithmeticError):
            msg = f"{path}: pose {number} is not a row of numbers: {' '.join(row)[:80]}"
            raise ExchangeError(msg) from None
    order = np.argsort(stamps, kind="stable")
    table = np.array(values)[order]
    covariance = table[:, 7:] if known_covariance else np.zeros((len(table), 36))
    return PoseTable(np.array(stamps, np.int64)[order], table[:, :3], table[:, 3:7], covariance)
