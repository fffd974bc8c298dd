# SPDX-License-Identifier: Apache-2.0
"""The ray caster against surfaces whose intersections are known."""

import numpy as np
import pytest

from quadtree_lss.lab.simulation.lidar import FlashLidar
from quadtree_lss.lab.simulation.terrain import Parabola, Terrain
from quadtree_lss.lab.simulation.trajectory import look_at


def _terrain(function, half=20.0, post=0.1):
    axis = np.linspace(-half, half, round(2 * half / post) + 1)
    return Terrain(axis, axis, function(axis[None, :], axis[:, None]))


def _fan(origin, targets):
    directions = np.asarray(targets, float) - origin
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _targets(generator, count=4000, half=12.0):
    return np.column_stack([generator.uniform(-half, half, (count, 2)), np.zeros(count)])


def test_hits_lie_on_rough_ground_and_nothing_is_in_front_of_them():
    generator = np.random.default_rng(3)
    terrain = _terrain(lambda x, y: generator.uniform(0.0, 0.6, (401, 401)))
    origin = np.array([-60.0, 5.0, 38.0])
    directions = _fan(origin, _targets(generator, 500))
    ranges = terrain.cast(origin, directions)
    points = origin + ranges[:, None] * directions
    surface = terrain.elevation_at(points[:, 0], points[:, 1])
    assert np.abs(points[:, 2] - surface).max() < 1e-6
    # Walk the ray in fine steps from above the highest post to just before the hit.
    backward = np.linspace(1e-6, 1.5, 400)
    before = points[:, None, :] - backward[None, :, None] * directions[:, None, :]
    clearance = before[..., 2] - terrain.elevation_at(before[..., 0], before[..., 1])
    assert clearance.min() > -1e-6


def _first_hit_of_all_cells(terrain, origin, direction):
    """The least root of ray minus bilinear surface over every cell, by numpy.roots."""
    dx, dy = terrain.post
    best = np.inf
    for j in range(terrain.y.size - 1):
        for i in range(terrain.x.size - 1):
            z = terrain.elevation[j : j + 2, i : i + 2]
            u = np.array([direction[0], origin[0] - terrain.x[i]]) / dx
            v = np.array([direction[1], origin[1] - terrain.y[j]]) / dy
            twist = z[0, 0] - z[0, 1] - z[1, 0] + z[1, 1]
            surface = np.convolve(u, v) * twist
            surface[1:] += (z[0, 1] - z[0, 0]) * u + (z[1, 0] - z[0, 0]) * v
            surface[2] += z[0, 0]
            surface[1:] -= [direction[2], origin[2]]
            for root in np.roots(surface):
                place = np.array([np.polyval(u, root.real), np.polyval(v, root.real)])
                inside = np.all((place > -1e-9) & (place < 1.0 + 1e-9))
                if abs(root.imag) < 1e-9 and root.real > 0.0 and inside:
                    best = min(best, root.real)
    return best if np.isfinite(best) else np.nan


@pytest.mark.parametrize("seed", [6, 7, 8])
def test_first_hit_is_the_least_root_of_all_cells(seed):
    generator = np.random.default_rng(seed)
    x, y = np.arange(12) * 0.5 - 3.0, np.arange(9) * 0.7 + 1.0
    terrain = Terrain(x, y, generator.uniform(0.0, 1.5, (9, 12)))
    origin = np.array([-6.0, 3.3, 4.0])
    targets = np.column_stack(
        [generator.uniform(-0.9, 5.0, 60), generator.uniform(0.0, 7.0, 60), np.zeros(60)]
    )
    targets[:10, 1] = origin[1]  # along x
    directions = _fan(origin, targets)
    over = np.array([0.37, 3.21, 9.0])
    cases = [(origin, d) for d in directions] + [(over, np.array([0.0, 0.0, -1.0]))]
    found = [terrain.cast(o, d[None])[0] for o, d in cases]
    np.testing.assert_allclose(
        found, [_first_hit_of_all_cells(terrain, o, d) for o, d in cases], atol=1e-6
    )
    assert np.isfinite(found).sum() > 20 and np.isnan(found).any()


def test_parabola_is_hit_where_its_elevation_says():
    parabola = Parabola()
    generator = np.random.default_rng(4)
    for origin in ([100.0, -100.0, 500.0], [0.0, 0.0, 20.0], [5.0, -5.0, 60.0]):
        origin = np.array(origin)
        directions = _fan(origin, _targets(generator, half=55.0))
        points = origin + parabola.cast(origin, directions)[:, None] * directions
        np.testing.assert_allclose(
            points[:, 2], parabola.elevation_at(points[:, 0], points[:, 1]), atol=1e-9
        )
        # The surface is convex: from above, a straight line meets it only once.
        half_way = origin + 0.5 * (points - origin)
        assert np.all(half_way[:, 2] > parabola.elevation_at(half_way[:, 0], half_way[:, 1]))


def test_parabola_straight_down_and_its_dem_agree():
    """Eq. 60."""
    parabola, down, origin = Parabola(), np.array([[0.0, 0.0, -1.0]]), np.array([30.0, 20.0, 100.0])
    expected = 100.0 - 3e-3 * (30.0**2 + 20.0**2 - 12.0**2)
    assert parabola.cast(origin, down)[0] == pytest.approx(expected)
    assert parabola.terrain().cast(origin, down)[0] == pytest.approx(expected, abs=1e-3)
    assert parabola.elevation_at(11.9, 0.0) == 0.0


def test_rays_that_miss_are_nan():
    terrain = _terrain(lambda x, y: 0.0 * x * y)
    origin = np.array([0.0, 0.0, 10.0])
    directions = _fan(origin, [[0.0, 0.0, 0.0], [0.0, 0.0, 20.0], [500.0, 0.0, 0.0], [9, 0, 10]])
    ranges = terrain.cast(origin, directions)
    assert ranges[0] == pytest.approx(10.0)
    assert np.isnan(ranges[1:]).all()


@pytest.mark.parametrize(("middle", "around", "end"), [(5.0, 3.0, 0.0), (0.0, 3.0, 1.0)])
def test_the_edge_of_a_dem_is_no_wall_and_from_below_there_is_nothing(middle, around, end):
    terrain = _terrain(lambda x, y: np.where(np.abs(x + y) < 1.0, middle, around))
    origin = np.array([-30.0, 0.0, 2.0])
    assert np.isnan(terrain.cast(origin, _fan(origin, [[0.0, 0.0, 2.0], [0.0, 0.0, end]]))).all()


def test_beams_follow_the_lidar_frame():
    directions = FlashLidar(field_of_view_deg=10.0).directions()
    assert directions.shape == (128, 128, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0)
    assert directions[64, 0, 0] < 0.0 < directions[64, -1, 0]  # x right
    assert directions[0, 64, 1] < 0.0 < directions[-1, 64, 1]  # y down
    width = np.degrees(np.arctan2(directions[64, -1, 0], directions[64, -1, 2]))
    assert width == pytest.approx(5.0 * 127 / 128)


def test_noise_outliers_and_dropouts():
    parabola = Parabola()
    position, target = np.array([0.0, 0.0, 100.0]), np.array([10.0, 0.0, 0.0])
    rotation = look_at(position, target)
    lidar = FlashLidar(field_of_view_deg=10.0, range_noise=0.08, outliers=0.1, dropouts=0.2)
    scan = lidar.scan(parabola, position, rotation, np.random.default_rng(5))
    error = np.linalg.norm(scan, axis=-1) - lidar.true_ranges(parabola, position, rotation)
    count = error.size
    lost = np.isnan(error).mean()
    assert abs(lost - 0.2) < 4.0 * np.sqrt(0.2 * 0.8 / count)
    error = error[np.isfinite(error)]
    wrong = np.abs(error) > 0.5
    assert abs(wrong.mean() - 0.1 * 0.95) < 4.0 * np.sqrt(0.1 * 0.9 / error.size)
    good = error[~wrong]
    # A few outliers are smaller than the threshold; the rest is the Gaussian.
    assert 1.4826 * np.median(np.abs(good)) == pytest.approx(0.08, rel=0.05)
    assert abs(np.median(good)) < 5e-3
