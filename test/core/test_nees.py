# SPDX-License-Identifier: Apache-2.0
"""Normalised estimation error of leaves and of fused parents, over whole maps of planar ground.

Each map is one draw of pose errors, so statistics are over maps: one leaf and one parent of each.
Range noise is large, for beside it the 0.015 m must not count that ground may be uneven.
"""

import functools

import numpy as np
import pytest
from core.builders import (
    GROUND,
    NORMAL,
    configured,
    disturbed,
    make_pose,
    nees,
    pose_covariance,
    scan,
    scattered,
)
from core.kernels import minus
from scipy.stats import chi2

from quadtree_lss.onboard.core.geometry.rotations import exp
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.tree.ancestors import fuse_to_level

MAPS = 250
CASES = {"range": (0.3, 1e-9, 1e-12), "pose": (1e-3, 0.2, 1e-3), "both": (0.3, 0.2, 1e-3)}


@functools.cache
def estimates(case: str, fit: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """(MAPS, 3) errors and (MAPS, 3, 3) covariances of a leaf and of the parent of all leaves."""
    noise, position, attitude = CASES[case]
    config = configured(
        domain={"size": 40.0, "min_level": 1, "max_level": 1},
        lidar={"range_noise": noise},
        mapping={"paper": fit},
        pose={"correlation_time": 0.0},
    )
    rng = np.random.default_rng(7)
    found: dict[str, list] = {"leaf": [], "parent": []}
    for _ in range(MAPS):
        mapper = Mapper(config)
        for k in range(2):
            turn = exp(rng.normal(0.0, 0.3, 3)) @ np.diag([1.0, -1.0, -1.0])
            at = (120.0, -90.0 + 60.0 * k, 250.0)
            pose = make_pose(at, pose_covariance(position, attitude), k, turn)
            x, y = scattered(rng, -5.0, -5.0, 50.0, 250)
            mapper.update(scan(GROUND, x, y, disturbed(pose, rng), noise, rng), pose)
        cells = mapper.snapshot()
        parent = fuse_to_level(cells, 0)
        for name, of, covariance in (
            ("leaf", cells, cells.covariance),
            ("parent", parent, parent.range_part + parent.pose_part),
        ):
            high = of.z[0] - GROUND(of.x[0], of.y[0])
            error = np.r_[minus(of.normal[0], NORMAL), NORMAL[2] * high]
            found[name].append((error, covariance[0]))
    return {
        name: (np.array([e for e, _ in rows]), np.array([c for _, c in rows]))
        for name, rows in found.items()
    }


@pytest.mark.parametrize("fit", ["none", "fit"])
@pytest.mark.parametrize("of", ["leaf", "parent"])
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("part", ["plane", "normal", "height"])
def test_normalised_error_is_chi_square(case, of, fit, part):
    """The mean over independent maps lies in the interval of its chi-square distribution.

    That of 1 - 1e-5: three dozen of these tests then fail once in 2,800 choices of the seed.
    """
    chosen = {"plane": [0, 1, 2], "normal": [0, 1], "height": [2]}[part]
    errors, covariances = estimates(case, fit)[of]
    errors, covariances = errors[:, chosen], covariances[:, chosen][:, :, chosen]
    low, high = chi2(len(chosen) * MAPS).interval(1.0 - 1e-5)
    assert low < nees(errors, covariances).sum() < high
