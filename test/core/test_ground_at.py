# SPDX-License-Identifier: Apache-2.0
"""The map asked at places and along lines; poses as matrices; what objects say of themselves."""

import numpy as np
import pytest
from core.builders import differentiated, upward_normals
from core.kernels import plus

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.tree.cell_map import height_by_error

CONFIG = load_config(
    (),
    {
        "domain.xmin": -8.0,
        "domain.ymin": -8.0,
        "domain.size": 16.0,
        "domain.min_level": 2,
        "domain.max_level": 4,
        "lidar.range_noise": 0.02,
        "lss.max_risk": 0.1,
    },
)
ABOVE = np.array([[1, 0, 0, 1], [0, -1, 0, 2], [0, 0, -1, 50], [0, 0, 0, 1]], float)


def inclined(x, y):
    return 3.0 + 0.1 * x - 0.05 * y


def cloud(rng):
    """Points on an inclined plane in the axes of a lidar at `ABOVE`, 2 cm of noise."""
    x, y = rng.uniform(-6.0, 6.0, (2, 4000))
    points = np.column_stack([x, y, inclined(x, y)]) - ABOVE[:3, 3]
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    return (points + rng.normal(scale=0.02, size=(len(x), 1)) * ray) @ ABOVE[:3, :3]


@pytest.fixture(scope="module")
def mapper():
    made = Mapper(CONFIG)
    made.update(cloud(np.random.default_rng(1)), Pose.from_matrix(ABOVE, position_sigma=0.01))
    return made


@pytest.fixture(scope="module")
def cells(mapper):
    return mapper.snapshot()


def test_height_and_slope_are_those_of_the_ground(cells):
    x, y = np.random.default_rng(2).uniform(-5.0, 5.0, (2, 50, 3))
    found = cells.at(x, y)
    assert found.height.shape == found.slope_deg.shape == found.deviation.shape == (50, 3)
    np.testing.assert_allclose(found.height, inclined(x, y), atol=0.03)
    np.testing.assert_allclose(found.slope_deg, np.degrees(np.arctan(np.hypot(0.1, 0.05))), atol=1)


def test_heights_change_with_a_planes_errors_as_differentiation_says():
    """Of steep planes, anywhere in a cell; so does the deviation that a place is told with."""
    rng = np.random.default_rng(3)
    normal, at = upward_normals(rng, 30, 1.0), rng.uniform(-4.0, 4.0, (30, 2))
    found = height_by_error(normal, *at.T)
    for n, place, row in zip(normal, at, found, strict=True):

        def height(error, n=n, place=place):
            turned = plus(n, error[:2])
            return np.array([error[2] - turned[:2] @ place]) / turned[2]

        np.testing.assert_allclose(row, differentiated(height, 3)[0], rtol=1e-6, atol=1e-6)


def test_the_deviation_is_that_of_the_cells_covariance(cells):
    leaf = int(np.flatnonzero(cells.measured)[3])
    off = np.array([0.3, -0.2]) * cells.size[leaf]
    by = height_by_error(cells.normal[[leaf]], *off[:, None])[0]
    found = cells.at(cells.x[leaf] + off[0], cells.y[leaf] + off[1]).deviation
    assert found == pytest.approx(np.sqrt(by @ cells.covariance[leaf] @ by), rel=1e-12)


def test_places_without_an_estimate_are_nan_and_scalars_stay_scalars(cells):
    outside = cells.at([-9.0, 8.0, np.nan, 0.0], [0.0, 0.0, 0.0, -8.1])
    assert all(np.isnan(values).all() for values in outside)
    one = cells.at(0.0, 0.0)
    assert np.ndim(one.height) == 0 and one.height == pytest.approx(3.0, abs=0.03)
    crossed = cells.at(np.linspace(-1, 1, 4), np.linspace(-1, 1, 3)[:, None])
    assert crossed.height.shape == (3, 4)


@pytest.mark.parametrize(
    ("matrix", "word"),
    [
        (np.eye(3), r"\(4, 4\)"),
        (np.diag([1.0, 1.0, np.nan, 1.0]), "finite"),
        (np.diag([1.0, 1.0, 1.0, 2.0]), "last row"),
        (np.diag([1.0, 1.0, 2.0, 1.0]), "not a rotation"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "not a rotation"),
    ],
)
def test_what_is_no_pose_is_refused(matrix, word):
    with pytest.raises(ValueError, match=word):
        Pose.from_matrix(matrix)
