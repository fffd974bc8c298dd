# SPDX-License-Identifier: Apache-2.0
"""Sweeps over the lattice, compiled: the odds that a lander fails, their table, and means of it."""

from __future__ import annotations

import cython
import numpy as np

from quadtree_lss.onboard.arrays import Array, Bytes, Single

if not cython.compiled:
    from math import log


@cython.boundscheck(False)
def set_odds(
    rise: Single,
    slope: Single,
    judged: Bytes,
    rise_odds: Array,
    slope_odds: Array,
    low: Array,
    step: float,
    within: Array,
    own: Array,
    about: Array,
) -> None:
    """Log odds that the lander fails at grid points, and how much greater they are beside them.

    Args:
        rise, slope: (ny, nx) of the worst rest, m and rise over run.
        judged: (ny, nx) where they are known; elsewhere the odds are the least.
        rise_odds, slope_odds: Odds that it fails by the one and by the other, from ``low`` (2,) in
            steps of ``step``: 1 + the odds that it fails is (1 + the one's) (1 + the other's).
        within: (2,) least and greatest log odds.
        own: (ny, nx), set.
        about: (ny, nx), set: how much greater those of the worst of the four neighbours are.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
    cython.declare(m=cython.Py_ssize_t)
    k_last: cython.Py_ssize_t = -1
    m_last: cython.Py_ssize_t = -1
    rows: cython.Py_ssize_t = own.shape[0]
    columns: cython.Py_ssize_t = own.shape[1]
    rise_last: cython.double = rise_odds.shape[0] - 1.0
    slope_last: cython.double = slope_odds.shape[0] - 1.0
    odds, least, greatest = 0.0, within[0], within[1]
    per = 1.0 / step
    with cython.nogil:
        for i in range(rows):
            for j in range(columns):
                if not judged[i, j]:
                    own[i, j] = least
                    continue
                place = min(max((rise[i, j] - low[0]) * per + 0.5, 0.0), rise_last)
                k = cython.cast(cython.Py_ssize_t, place)
                place = min(max((slope[i, j] - low[1]) * per + 0.5, 0.0), slope_last)
                m = cython.cast(cython.Py_ssize_t, place)
                if k != k_last or m != m_last:  # level ground is all alike
                    odds = log(rise_odds[k] + slope_odds[m] + rise_odds[k] * slope_odds[m])
                    odds = min(max(odds, least), greatest)
                    k_last, m_last = k, m
                own[i, j] = odds
        for i in range(rows):
            for j in range(columns):
                worst = own[i, j]
                if i > 0:
                    worst = max(worst, own[i - 1, j])
                if i < rows - 1:
                    worst = max(worst, own[i + 1, j])
                if j > 0:
                    worst = max(worst, own[i, j - 1])
                if j < columns - 1:
                    worst = max(worst, own[i, j + 1])
                about[i, j] = worst - own[i, j]


@cython.boundscheck(False)
def look_up(
    own: Array, about: Array, judged: Bytes, table: Array, least: float, step: float, out: Array
) -> None:
    """Set P(unsafe) at grid points (ny, nx): by a table of the log odds ``set_odds`` gives.

    Args:
        own, about: (ny, nx).
        judged: (ny, nx) where they are known; elsewhere the lander fails.
        table: (K, M), of ``own`` from ``least`` and of ``about`` from 0, in steps of ``step``.
        least: Log odds.
        step: Of log odds.
        out: (ny, nx), set.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
    cython.declare(m=cython.Py_ssize_t)
    k_last: cython.Py_ssize_t = table.shape[0] - 1
    m_last: cython.Py_ssize_t = table.shape[1] - 1
    per = 1.0 / step
    with cython.nogil:
        for i in range(out.shape[0]):
            for j in range(out.shape[1]):
                if judged[i, j]:
                    k = cython.cast(cython.Py_ssize_t, (own[i, j] - least) * per + 0.5)
                    m = cython.cast(cython.Py_ssize_t, about[i, j] * per + 0.5)
                    out[i, j] = table[min(k, k_last), min(m, m_last)]
                else:
                    out[i, j] = 1.0


@cython.boundscheck(False)
def blur(risk: Array, across: Array, along: Array, out: Array) -> None:
    """Weighted means of P(unsafe) about each grid point; beyond the lattice it is 1.

    Args:
        risk: (ny, nx).
        across, along: (K + 1,), (L + 1,) weights of rows and columns so far from the grid point;
            on both sides they are alike. K and L are even.
        out: (ny, nx), set.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
    rows: cython.Py_ssize_t = risk.shape[0]
    columns: cython.Py_ssize_t = risk.shape[1]
    up: cython.Py_ssize_t = across.shape[0] - 1
    right: cython.Py_ssize_t = along.shape[0] - 1
    # Of P(safe): beyond the lattice there is none.
    safe = cython.declare(cython.double[:, ::1], np.zeros((rows + 2 * up, columns)))
    line = cython.declare(cython.double[::1], np.zeros(columns + 2 * right))
    with cython.nogil:
        for i in range(rows):
            for j in range(columns):
                line[right + j] = 1.0 - risk[i, j]
            for j in range(columns):
                safe[up + i, j] = along[0] * line[right + j]
            for k in range(1, right, 2):
                near, far = along[k], along[k + 1]
                for j in range(right, right + columns):
                    z = near * (line[j - k] + line[j + k])
                    z += far * (line[j - k - 1] + line[j + k + 1])
                    safe[up + i, j - right] += z
        for i in range(rows):
            for j in range(columns):
                out[i, j] = 1.0 - across[0] * safe[up + i, j]
            for k in range(1, up, 2):
                near, far = across[k], across[k + 1]
                south: cython.Py_ssize_t = up + i - k
                north: cython.Py_ssize_t = up + i + k
                for j in range(columns):
                    z = near * (safe[south, j] + safe[north, j])
                    z += far * (safe[south - 1, j] + safe[north + 1, j])
                    out[i, j] -= z
            for j in range(columns):
                out[i, j] = min(max(out[i, j], 0.0), 1.0)
