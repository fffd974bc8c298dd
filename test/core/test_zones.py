# SPDX-License-Identifier: Apache-2.0
"""What zones meet, against every cell and point looked at."""

from __future__ import annotations

import numpy as np
import pytest

from quadtree_lss.onboard.core.landing.lattice import disc
from quadtree_lss.onboard.core.landing.zones import greatest_in_zones, lower_room

SIDE, N = 0.5, 24


@pytest.mark.parametrize("half", [0.0, 0.5])
@pytest.mark.parametrize("share", [0.0, 0.002, 0.05, 1.0])
def test_room_ends_at_the_nearest_mark(half, share):
    rng = np.random.default_rng(5)
    marked = rng.random((N + (half == 0.0),) * 2) < share
    x, y = rng.uniform(0.0, N * SIDE, (2, 50))
    x[:3], y[:3] = (0.0, N * SIDE, 4 * SIDE), (0.0, N * SIDE, 3 * SIDE)
    room = np.full(50, 3.0)
    lower_room(marked.view(np.uint8), half, x, y, SIDE, 0.7, room)
    row, column = np.nonzero(marked)
    for k in range(50):
        dx = np.maximum(np.abs(x[k] / SIDE - column - half) - half, 0.0)
        dy = np.maximum(np.abs(y[k] / SIDE - row - half) - half, 0.0)
        nearest = SIDE * np.min(np.hypot(dx, dy), initial=np.inf)
        assert room[k] == pytest.approx(min(3.0, nearest - 0.7), abs=1e-12)


@pytest.mark.parametrize("radius", [0.1, 1.3, 4.0])
def test_greatest_is_that_of_the_cells_in_the_disc(radius):
    rng = np.random.default_rng(6)
    cells, of_leaf = rng.random((N, N)), rng.random(30)
    leaf = rng.integers(0, 30, (N, N), dtype=np.int32)
    places = np.array([[0, 5, N, 12, N], [0, 7, N, 23, 3]])
    over, out = disc(radius, SIDE), np.empty((2, 5))
    greatest_in_zones(cells, leaf, of_leaf, over.half, places, out)
    for k in range(5):
        row, column = places[0, k] + over.row, places[1, k] + over.column
        within = (row >= 0) & (row < N) & (column >= 0) & (column < N)
        row, column = row[within], column[within]
        assert out[0, k] == cells[row, column].max()
        assert out[1, k] == of_leaf[leaf[row, column]].max()
