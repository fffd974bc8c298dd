# SPDX-License-Identifier: Apache-2.0
"""The finest lattice seen from the user's grid."""

from __future__ import annotations

import numpy as np

from quadtree_lss.onboard.core.landing.grid import GridSampler
from quadtree_lss.onboard.core.tree.domain import Domain


def test_grid_points_between_lattice_points_take_the_nearest():
    """Lattice points lie half a metre apart."""
    x, y = np.array([0.7, 1.3]), np.array([0.8, 1.9])
    sampler = GridSampler(Domain(0.0, 0.0, 4.0, 0, 3), x, y)
    row, column = sampler.lattice(np.array([0, 1]), np.array([0, 1]))
    assert row.tolist() == [2, 4]
    assert column.tolist() == [1, 3]
    values = np.arange(81.0).reshape(9, 9)
    np.testing.assert_array_equal(sampler.nearest(values), values[np.ix_(row, column)])
