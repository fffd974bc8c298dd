# SPDX-License-Identifier: Apache-2.0
"""Signed distance from polygons against sampling and a general point-in-polygon test."""

import numpy as np
import pytest
from matplotlib.path import Path

from quadtree_lss.onboard.core.geometry.polygons import signed_distance

SQUARE = [(0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0)]
NOTCHED = [(0.0, 0.0), (6.0, 0.0), (6.0, 5.0), (3.0, 1.0), (0.0, 5.0)]


def places(count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    return np.random.default_rng(1).uniform(-3.0, 9.0, (2, count))


@pytest.mark.parametrize("polygon", [SQUARE, NOTCHED, NOTCHED[::-1]], ids=["square", "L", "turned"])
def test_sign_tells_inside(polygon):
    x, y = places()
    inside = Path(polygon).contains_points(np.column_stack([x, y]))
    np.testing.assert_array_equal(signed_distance(polygon, x, y) > 0.0, inside)


@pytest.mark.parametrize("polygon", [SQUARE, NOTCHED])
def test_length_is_the_distance_to_the_edge(polygon):
    x, y = places()
    corners = np.array(polygon)
    along = np.roll(corners, -1, axis=0) - corners
    edge = corners + np.linspace(0.0, 1.0, 2001)[:, None, None] * along
    edge = edge.reshape(-1, 2)
    nearest = np.hypot(x[:, None] - edge[:, 0], y[:, None] - edge[:, 1]).min(axis=1)
    # Samples are at most 1.6 mm from any point of an edge.
    np.testing.assert_allclose(np.abs(signed_distance(polygon, x, y)), nearest, atol=2e-3)


def test_any_shape_a_third_column_and_a_repeated_vertex_are_taken():
    x, y = (v.reshape(20, 20) for v in places())
    flat = signed_distance(SQUARE, x, y)
    assert flat.shape == (20, 20)
    np.testing.assert_array_equal(signed_distance([(*c, 7.0) for c in SQUARE], x, y), flat)
    np.testing.assert_array_equal(signed_distance([*SQUARE, SQUARE[0]], x, y), flat)


@pytest.mark.parametrize(
    "polygon",
    [
        [],
        [(0, 0), (1, 1)],
        [(0.0,), (1.0,), (2.0,)],
        [(0, 0), (1, 0), (np.nan, 1)],
        [0.0, 1.0, 2.0],
    ],
)
def test_what_is_no_polygon_is_refused(polygon):
    with pytest.raises(ValueError, match="polygon"):
        signed_distance(polygon, np.zeros(1), np.zeros(1))
