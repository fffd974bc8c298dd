# SPDX-License-Identifier: Apache-2.0
"""What the check of checkpoints says of covariances, against their eigenvalues."""

from __future__ import annotations

import numpy as np
import pytest

from quadtree_lss.onboard.core.tree.checkpoint import _covariances
from quadtree_lss.onboard.core.tree.leaves import LEAF

SCALES = np.array([1e-6, 3e-3, 40.0])
"""Deviations as unlike as those of a slope and of a height."""


def planes(correlation):
    result = np.zeros(1, dtype=LEAF)
    result["range_part"] = (correlation * np.outer(SCALES, SCALES)).reshape(1, 9)
    result["pose_part"] = 1e-3 * np.eye(3).reshape(1, 9)
    return result


@pytest.mark.parametrize("seed", range(3))
def test_agrees_with_eigenvalues(seed):
    rng = np.random.default_rng(seed)
    seen = set()
    for _ in range(500):
        a, b, c = rng.uniform(-1.1, 1.1, 3)
        correlation = np.array([[1.0, a, b], [a, 1.0, c], [b, c, 1.0]])
        least = np.linalg.eigvalsh(correlation)[0]
        if abs(least) < 1e-4:
            continue
        assert _covariances(planes(correlation)) == (least > 0.0)
        seen.add(least > 0.0)
    assert seen == {True, False}


def test_singular_zero_and_skew():
    ones = np.ones((3, 3))
    assert _covariances(planes(ones)) and _covariances(planes(np.zeros((3, 3))))
    assert _covariances(planes(np.zeros((3, 3)))[:0]), "of no plane"
    skew = np.eye(3)
    skew[0, 1] = 0.5
    assert not _covariances(planes(skew))
    lonely = np.diag([0.0, 1.0, 1.0])
    assert _covariances(planes(lonely))
    lonely[0, 1] = lonely[1, 0] = 1e-3
    assert not _covariances(planes(lonely)), "correlated with what has no variance"
