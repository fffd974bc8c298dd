# SPDX-License-Identifier: Apache-2.0
"""Distances on a lattice: to the nearest marked node, and what lies within a distance of one."""

from __future__ import annotations

from math import isqrt, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Longest distance in steps whose square, and the sum of two, fit 16 bits.
LONGEST = 127


def distance_from(marked: Mask, side: float, cap: float = np.inf) -> Array:
    """Distance in m of each node to the nearest marked one, infinite if none is marked.

    Args:
        marked: (ny, nx).
        side: Of the lattice, m.
        cap: Distances over it may be given as infinite, m.
    """
    if not marked.any():
        return np.full(marked.shape, np.inf)
    steps = int(min(np.ceil(cap / side), 1e9))
    if steps <= LONGEST:
        return _near_distance(marked, steps) * side
    out: Array = distance_transform_edt(~marked) * side
    return out


def _near_distance(marked: Mask, steps: int) -> Array:
    """Distances up to ``steps`` in steps, infinite beyond.

    Rows first, by jumps of 1, 2, 4, ... steps; then over rows, min of (squared distance in a row +
    squared distance of the row).
    """
    beyond = steps + 1
    column = np.where(marked, np.int16(0), np.int16(beyond))
    jump = 1
    while jump <= steps:
        low, high = column[:, :-jump].copy(), column[:, jump:].copy()
        np.minimum(column[:, jump:], low + np.int16(jump), out=column[:, jump:])
        np.minimum(column[:, :-jump], high + np.int16(jump), out=column[:, :-jump])
        jump *= 2
    np.minimum(column, beyond, out=column)
    square = column * column
    out = square.copy()
    for row in range(1, min(steps, len(marked) - 1) + 1):
        if row % 8 == 0 and row * row >= out.max():
            break
        part = square + np.int16(row * row)
        np.minimum(out[row:], part[:-row], out=out[row:])
        np.minimum(out[:-row], part[row:], out=out[:-row])
    root = np.sqrt(np.arange(beyond * beyond + 1, dtype=np.float64))
    root[steps * steps + 1 :] = np.inf
    found: Array = root.take(np.minimum(out, beyond * beyond))
    return found


def grown(marked: Mask, distance: float, side: float, short: float = 0.0) -> Mask:
    """Nodes within ``distance`` (m) of a marked one, the marked ones included.

    Args:
        marked: (ny, nx).
        distance: m.
        side: Of the lattice, m.
        short: Steps by which distances are taken to be shorter.
    """
    if not marked.any():
        return marked.copy()
    longest = sum(marked.shape)
    square = int(min(distance / side + short, longest) ** 2) + 2
    while square > 0 and (sqrt(square) - short) * side > distance:
        square -= 1
    out: Mask = marked.copy()
    run = marked.copy()
    reach, width = min(isqrt(square), len(marked) - 1), 0
    # A disc is a stack of centred runs: the farthest row has the shortest.
    for row in range(reach, -1, -1):
        while width < isqrt(square - row * row) and width < marked.shape[1] - 1:
            width += 1
            run[:, width:] |= marked[:, :-width]
            run[:, :-width] |= marked[:, width:]
        out[row:] |= run[: len(run) - row]
        out[: len(run) - row] |= run[row:]
    return out
