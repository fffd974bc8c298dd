# SPDX-License-Identifier: Apache-2.0
"""What zones meet, against every cell and point looked at."""

from __future__ import annotations

import numpy as np
import pytest

from quadtree_lss.onboard.core.landing.score import lower_room

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
