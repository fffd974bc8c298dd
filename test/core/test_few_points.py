# SPDX-License-Identifier: Apache-2.0
"""Cells that get one or two points a scan: hints until they tell a plane, heights after that."""

import numpy as np
import pytest
from core.builders import configured, leaf_at, look, nees, plane_errors
from core.scenes import ABOVE, flat, make_pose, pose_covariance, scattered, slope

from quadtree_lss.onboard.core.mapping.mapper import Mapper

FINEST_1M = {"min_level": 4, "max_level": 4}


@pytest.mark.parametrize("fit", ["none", "fit"])
def test_two_points_a_scan_make_a_plane_in_time(fit):
    """Never a fit by themselves; a few scans together tell slope and height."""
    ground, gradient = slope(0.12, -0.07, 30.0), np.array([-0.12, 0.07, 1.0])
    config = configured(domain=FINEST_1M, noise=0.01, mapping={"paper": fit})
    rng, mapper = np.random.default_rng(4), Mapper(config)
    corners = np.stack(np.meshgrid(*[np.arange(16.0)] * 2)).reshape(2, 1, 256)
    for k in range(12):
        x, y = corners + rng.random((2, 2, 256))
        look(mapper, ground, x.ravel(), y.ravel(), rng, 0.01, make_pose(ABOVE, stamp_ns=k + 1))
        if k == 0:
            assert not mapper.snapshot().measured.any()
    cells = mapper.snapshot()
    assert np.mean(cells.measured) > 0.95
    error = plane_errors(cells, gradient / np.linalg.norm(gradient), ground)[cells.measured]
    assert np.median(np.abs(error)) < 0.03
    # The median of a chi-square of three degrees is 2.37.
    assert np.median(nees(error, cells.covariance[cells.measured])) < 2.0 * 2.37


def under_lines(ground, spacing: float, aside: float, step: float):
    """A map of 1 m cells after 150 scans; lines in every third, ``step`` m farther each scan."""
    noise, rng = 0.16, np.random.default_rng(3)
    mapper = Mapper(configured(domain=FINEST_1M, noise=noise))
    for k in range(150):
        y = np.arange(-1.0, 17.0, spacing) + spacing * rng.random()
        x, y = np.meshgrid(np.arange(-2.7, 19.0, 3.0) + (step * k) % 3.0, y)
        pose = make_pose((8.0 - 100.0 * aside, 8.0, 130.0), stamp_ns=100_000_000 * (k + 1))
        look(mapper, ground, x.ravel(), y.ravel(), rng, noise, pose)
    return mapper.snapshot()


@pytest.mark.parametrize("ground", [flat(), slope(0.1, 0.05, 30.0)], ids=["level", "inclined"])
@pytest.mark.parametrize("aside", [0.1, 0.4])
@pytest.mark.parametrize("spacing", [1.4, 0.7, 0.22])
def test_single_lines_that_sweep_over_cells_tell_their_planes(spacing, aside, ground):
    """As of a spinning lidar: every third cell has a line of a scan, of one to five points.

    Noise moves points along the ray, by more than what a line is wide; it is no width.
    """
    cells = under_lines(ground, spacing, aside, step=0.16)
    inner = cells.measured & (abs(cells.x - 8.0) < 6.0) & (abs(cells.y - 8.0) < 6.0)
    assert np.count_nonzero(inner) == 144
    x, y = cells.x[inner], cells.y[inner]
    true = [(ground(x + d, y + e) - ground(x - d, y - e)) / 2.0 for d, e in np.eye(2)]
    error = -(cells.normal[inner, :2] / cells.normal[inner, 2:]).T - true
    assert np.median(np.abs(error), axis=1).max() < 0.11
    assert np.quantile(np.abs(error), 0.98) < 0.4


@pytest.mark.parametrize("seed", range(10))
def test_a_strip_first_does_not_starve_a_steep_cell(seed):
    """1 m cells at 45 degrees: points of a strip, again and again, then three good scans."""
    ground = slope(1.0, 0.0)
    config = configured(domain=FINEST_1M, noise=0.05)
    rng, mapper = np.random.default_rng(seed), Mapper(config)
    for k in range(32):
        x, y = np.array([8.0 + 0.05 * rng.random()]), np.array([8.0 + rng.random()])
        look(mapper, ground, x, y, rng, 0.05, make_pose(ABOVE, stamp_ns=k + 1))
    for k in range(3):
        pose = make_pose(ABOVE, stamp_ns=100 + k)
        look(mapper, ground, *scattered(rng, 8.0, 8.0, 1.0, 40), rng, 0.05, pose)
    leaf = leaf_at(mapper, 8.5, 8.5)
    assert leaf.state == 3
    assert leaf.z == pytest.approx(8.5, abs=0.1)
    assert -leaf.normal[0] / leaf.normal[2] == pytest.approx(1.0, abs=0.15)


def sparse(ground, points: int, scans: int, seed: int, sigma: float = 0.0, **sections):
    """Leaves of 4 m, which may divide, of so many points a scan each; poses err as they say."""
    config = configured(levels=(2, 6), noise=0.06, **sections)
    rng, mapper = np.random.default_rng(seed), Mapper(config)
    corners = 4.0 * np.stack(np.meshgrid(*[np.arange(4.0)] * 2)).reshape(2, 1, 16)
    for k in range(scans):
        x, y = corners + 4.0 * rng.random((2, points, 16))
        told = make_pose(ABOVE, pose_covariance(sigma, 1e-9), stamp_ns=100_000_000 * (k + 1))
        off = float(sigma * rng.standard_normal())
        look(mapper, ground, x.ravel(), y.ravel(), rng, 0.06, told, high=off)
    return mapper


def boulder(x, y):
    """A block of 1.2 m, 0.45 m high, on level ground, in one leaf."""
    return 0.45 * ((np.abs(x - 9.7) < 0.6) & (np.abs(y - 6.1) < 0.6))


@pytest.mark.parametrize("points", [1, 2, 3])
def test_a_rock_shows_by_single_returns(points):
    """Its leaf divides, however few points a scan leaves there: it is on the map, or unknown."""
    mapper = sparse(boulder, points, 90 // points, seed=5)
    assert leaf_at(mapper, 9.7, 6.1).level > 2
    others = [leaf_at(mapper, x, y).level for x in (2.0, 6.0, 14.0) for y in (2.0, 10.0, 14.0)]
    assert max(others) == 2


@pytest.mark.parametrize("sigma", [0.0, 0.2])
@pytest.mark.parametrize("points", [1, 2, 3])
def test_residuals_of_few_points_are_as_large_as_noise_makes_them(points, sigma):
    """On level ground, by exact poses and such as err from scan to scan; hardly a leaf divides."""
    pose = {"correlation_time": 0.0}
    mapper = sparse(flat(), points, 300 // points, seed=6, sigma=sigma, pose=pose)
    rows = mapper.leaves.rows[: mapper.leaves.count]
    assert len(rows) <= 16 + 2 * 3
    ratio = rows["distance_sum"].sum() / rows["noise_sum"].sum()
    # While poses tell little, hardly anything of a residual is left; noise counts half at least.
    assert 0.75 < ratio < 1.1
