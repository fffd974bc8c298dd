# SPDX-License-Identifier: Apache-2.0
"""The ray caster against surfaces whose intersections are known."""

import numpy as np
import pytest

from quadtree_lss.lab.simulation.lidar import FlashLidar
from quadtree_lss.lab.simulation.terrain import Terrain, parabola
from quadtree_lss.lab.simulation.trajectory import look_at


def _terrain(function):
    axis = np.linspace(-20.0, 20.0, 401)
    return Terrain(axis, axis, function(axis[None, :], axis[:, None]))


def _fan(origin, targets):
    directions = np.asarray(targets, float) - origin
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _first_hit_of_all_cells(terrain, origin, direction):
    """The least root of ray minus bilinear surface over the cells that the ray crosses, in turn, by
    numpy.roots; none if it comes in through the side below the surface."""
    count, post = np.array([terrain.x.size, terrain.y.size]) - 1, np.array(terrain.post)
    start = (origin[:2] - [terrain.x[0], terrain.y[0]]) / post
    along = direction[:2] / post
    lines = [(np.arange(n + 1) - s) / v for n, s, v in zip(count, start, along, strict=True) if v]
    edges, within = np.unique(np.concatenate([[0.0, 1e4], *lines])), False
    for near, far in zip(edges[:-1], edges[1:], strict=True):
        i, j = cell = np.floor(start + 0.5 * (near + far) * along).astype(int)
        if near < 0.0 or (cell < 0).any() or (cell >= count).any():
            continue
        z = terrain.elevation[j : j + 2, i : i + 2]
        u, v = np.stack([along, start - cell], axis=1)
        twist = z[0, 0] - z[0, 1] - z[1, 0] + z[1, 1]
        surface = np.convolve(u, v) * twist
        surface[1:] += (z[0, 1] - z[0, 0]) * u + (z[1, 0] - z[0, 0]) * v
        surface[2] += z[0, 0]
        surface[1:] -= [direction[2], origin[2]]
        roots = [root.real for root in np.roots(surface) if abs(root.imag) < 1e-12]
        if not within and np.polyval(surface, near) >= 0.0:
            break
        within = True
        if found := [root for root in roots if near - 1e-9 <= root <= far + 1e-9]:
            return min(found)
    return np.nan


@pytest.mark.parametrize("seed", [6, 12, 17])
def test_first_hit_is_the_least_root_of_all_cells(seed):
    """Over rough ground with needles, a wall and a trench, from afar, from near, straight down."""
    generator = np.random.default_rng(seed)
    x, y = np.arange(290) * 0.1 - 3.0, np.arange(150) * 0.13 + 1.0
    elevation = generator.uniform(0.0, 0.3, (150, 290))
    needles = generator.integers(0, 150, 40), generator.integers(0, 290, 40)
    elevation[needles] += generator.uniform(0.0, 8.0, 40)
    elevation[:, 100] += 2.0
    elevation[70] -= 4.0
    terrain, rays = Terrain(x, y, elevation), []
    for away in (0.0, 1.0, 100.0):
        for _ in range(60):
            target = np.array([*generator.uniform([-3.0, 1.0], [25.9, 20.3]), 0.0])
            target[2] = generator.uniform(-1.0, 4.0)
            up = 9.0 + generator.uniform(0.0, 20.0)
            origin = target + [*(away * generator.standard_normal(2)), up]
            origin[1] = target[1] if len(rays) % 7 == 0 else origin[1]  # along x
            rays.append((origin, _fan(origin, target[None])))
    found = [terrain.cast(*ray)[0] for ray in rays]
    expected = [_first_hit_of_all_cells(terrain, origin, fan[0]) for origin, fan in rays]
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert 100 < np.isfinite(found).sum() < len(found)


def test_rays_that_miss_are_nan():
    terrain = _terrain(lambda x, y: 0.0 * x * y)
    origin = np.array([0.0, 0.0, 10.0])
    directions = _fan(origin, [[0.0, 0.0, 0.0], [0.0, 0.0, 20.0], [500.0, 0.0, 0.0], [9, 0, 10]])
    ranges = terrain.cast(origin, directions)
    assert ranges[0] == pytest.approx(10.0)
    assert np.isnan(ranges[1:]).all()


def test_beams_follow_the_lidar_frame():
    directions = FlashLidar(field_of_view_deg=10.0).directions()
    assert directions.shape == (128, 128, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0)
    assert directions[64, 0, 0] < 0.0 < directions[64, -1, 0]  # x right
    assert directions[0, 64, 1] < 0.0 < directions[-1, 64, 1]  # y down
    width = np.degrees(np.arctan2(directions[64, -1, 0], directions[64, -1, 2]))
    assert width == pytest.approx(5.0 * 127 / 128)


def test_noise_outliers_and_dropouts():
    ground = parabola()
    position, target = np.array([0.0, 0.0, 100.0]), np.array([10.0, 0.0, 0.0])
    rotation = look_at(position, target)
    lidar = FlashLidar(field_of_view_deg=10.0, range_noise=0.08, outliers=0.1, dropouts=0.2)
    scan = lidar.scan(ground, position, rotation, np.random.default_rng(5))
    error = np.linalg.norm(scan, axis=-1) - lidar.true_ranges(ground, position, rotation)
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
