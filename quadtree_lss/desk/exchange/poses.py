# SPDX-License-Identifier: Apache-2.0
"""Poses in text files: TUM's form, or CSV with a header."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
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
    if not lines:
        msg = f"{path}: there is no pose in it"
        raise ExchangeError(msg)
    comma = "," in lines[0]
    rows = list(csv.reader(lines)) if comma else [line.split() for line in lines]
    header, known = [name.strip() for name in rows[0]], set(rows[0]) & {"x", "qw", "stamp_ns"}
    if known or not _is_number(header[0]):
        rows = rows[1:]
    else:
        header = list(TUM)
    place = {name: k for k, name in enumerate(header)}
    clock = next((name for name in ("stamp_ns", "stamp") if name in place), None)
    missing = [name for name in TUM[1:] if name not in place]
    if clock is None or missing:
        lack = ", ".join(missing or ["stamp_ns"])
        msg = f"{path}: lacks {lack}: poses are lines of TUM (stamp x y z qx qy qz qw) or CSV"
        raise ExchangeError(msg)
    stamps, values = [], []
    known_covariance = all(name in place for name in COVARIANCE)
    wanted = [*TUM[1:], *(COVARIANCE if known_covariance else ())]
    for number, row in enumerate(rows, start=1):
        try:
            exact = Decimal(row[place[clock]].strip())
            stamps.append(np.int64(int(exact if clock == "stamp_ns" else exact * 10**9)))
            values.append([float(row[place[name]]) for name in wanted])
        except (ValueError, IndexError, InvalidOperation, OverflowError):
            msg = f"{path}: pose {number} is not a row of numbers: {' '.join(row)[:80]}"
            raise ExchangeError(msg) from None
    if not stamps:
        msg = f"{path}: there is no pose in it"
        raise ExchangeError(msg)
    order = np.argsort(stamps, kind="stable")
    table = np.array(values)[order]
    covariance = table[:, 7:] if known_covariance else np.zeros((len(table), 36))
    return PoseTable(np.array(stamps, np.int64)[order], table[:, :3], table[:, 3:7], covariance)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
