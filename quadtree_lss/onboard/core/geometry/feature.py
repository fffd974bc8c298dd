# SPDX-License-Identifier: Apache-2.0
"""The shape of a subscale feature (paper V.C): Eq. 49, Eq. 50, Eq. 51 and Eq. 57 with their errata.

Height over the cell's plane is A + p exp(-r^2 / 2 sigma^2) with p = k^2 / (2 pi sigma^2), so that
k^2 is the bump's volume. The state is (A, k, mu_x, mu_y, sigma), the centre relative to the cell's.
"""

from __future__ import annotations

import numpy as np

from quadtree_lss.onboard.arrays import Array

#: Peak of the bell that fits a hemisphere (Eq. 53) best over the hemisphere's height.
SHAPE = 1.25


def peak(state: Array) -> Array:
    """Height of bumps over their surroundings, k^2 / (2 pi sigma^2): (..., 5) to (...), m."""
    out: Array = state[..., 1] ** 2 / (2.0 * np.pi * state[..., 4] ** 2)
    return out
