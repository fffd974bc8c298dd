# SPDX-License-Identifier: Apache-2.0
"""Scans that navigation puts beside the map come to lie on it; errors that are news are shared."""

import numpy as np
import pytest
from core.builders import configured, look, mapped
from core.scenes import ABOVE, flat, lattice, make_pose, pose_covariance, scattered

from quadtree_lss.onboard.core.mapping.alignment import height_offset, lift_map
from quadtree_lss.onboard.core.mapping.mapper import Mapper

NOISE = 0.02
CELLS = {"min_level": 4, "max_level": 4}


def cells_of(
    rise, own=1e-4, scan_variance=0.09, map_variance=0.01, first=0.0, last=0.0
) -> np.ndarray:
    """Return the cells that `height_offset` takes, with this rise."""
    rise = np.asarray(rise, dtype=np.float64)
    columns = (rise, own, scan_variance, map_variance, first, last)
    return np.array([np.broadcast_to(column, rise.shape) for column in columns], dtype=np.float64)


def test_the_offset_is_the_weighted_mean():
    rng = np.random.default_rng(1)
    own = rng.uniform(0.01, 0.3, 500) ** 2
    rise = 0.2 + np.sqrt(own) * rng.uniform(-1.5, 1.5, 500)
    found = height_offset(cells_of(rise, own), 0.0, 0.0)
    expected = np.average(rise, weights=1.0 / own)
    assert found.height == pytest.approx(expected, abs=0.005)
    assert found.height == pytest.approx(0.2, abs=0.01)


@pytest.mark.parametrize("wild", [0.3, 5.0])
def test_a_few_wild_cells_do_not_move_a_scan(wild):
    """Off by what poses may be, or by far more."""
    rise = np.random.default_rng(2).normal(0.0, 0.01, 200)
    rise[:20] = wild
    assert abs(height_offset(cells_of(rise), 0.0, 0.0).height) < 0.01


@pytest.mark.parametrize(
    ("scan_variance", "map_variance"), [(0.25, 0.25), (0.01, 0.2), (0.2, 0.01)]
)
def test_an_offset_divides_as_the_pose_errors_do(scan_variance, map_variance):
    """Against draws: the mean of either error, given their difference."""
    rng = np.random.default_rng(3)
    scan_error = np.sqrt(scan_variance) * rng.standard_normal(400_000)
    map_error = np.sqrt(map_variance) * rng.standard_normal(400_000)
    offset = scan_error - map_error + 0.04 * rng.standard_normal(400_000)
    near = np.abs(offset - 0.3) < 0.02
    found = height_offset(cells_of(np.full(50, 0.3), 1e-6, scan_variance, map_variance), 0.0, 0.0)
    assert found.scan_part == pytest.approx(scan_error[near].mean(), abs=0.01)
    assert found.map_part == pytest.approx(-map_error[near].mean(), abs=0.01)


def steps(x, y):
    """A cliff of 5 m across a slope."""
    return 0.3 * x + 5.0 * (y + 0.3 * x > 9.0)


def test_an_error_that_persists_stays_as_it_is_and_one_that_is_old_is_news():
    cells = cells_of(np.full(50, 0.05), last=10.0)
    small, large = (height_offset(cells, 10.0 + later, 100.0) for later in (0.05, 1000.0))
    assert abs(small.scan_part) < 0.003
    assert large.scan_part == pytest.approx(height_offset(cells, 10.0, 0.0).scan_part, rel=1e-3)


def test_a_jump_is_news_however_soon():
    cells = cells_of(np.full(50, 0.5), last=10.0)
    assert height_offset(cells, 10.05, 300.0) == height_offset(cells, 10.05, 0.0)


def test_leaves_are_lifted_as_far_as_they_share_the_error():
    """A leaf of ten seconds shares the half of it from when the compared ground began."""
    mapper = mapped(configured(domain=CELLS), flat(), scans=1)
    rows = mapper.leaves.rows
    rows.z[:] = rows.low[:] = rows.high[:] = 0.0
    rows.first_time[:4], rows.last_time[:4] = (0.0, 0.0, 6.0, 8.0), (10.0, 4.0, 6.0, 20.0)
    rows.state[4] = 0
    lift_map(mapper.leaves, 0.2, 5.0)
    for name in ("z", "low", "high"):
        np.testing.assert_allclose(rows[name][:5], [0.1, 0.0, 0.2, 0.2, 0.0], atol=1e-4)


def fly(mapper: Mapper, surface, errors, rng, covariance=None, points=12000, start=1.0) -> None:
    """Scans straight down, a second apart; poses are too high by each of ``errors`` (K,)."""
    sigma = pose_covariance(0.3, 1e-9) if covariance is None else covariance
    for number, error in enumerate(errors):
        pose = make_pose(ABOVE, sigma, round(1e9 * (start + number)))
        look(mapper, surface, *scattered(rng, 0.0, 0.0, 16.0, points), rng, NOISE, pose, error)


def mapper_of(correlation_time: float = 300.0, **mapping: object) -> Mapper:
    pose = {"correlation_time": correlation_time}
    return Mapper(configured(domain=CELLS, noise=NOISE, mapping=mapping, pose=pose))


def test_new_ground_joins_at_the_height_of_the_old():
    """A scan that sees half of the map again: both halves are level in the end."""
    rng, mapper, sigma = np.random.default_rng(6), mapper_of(0.0), pose_covariance(0.3, 1e-9)
    for number, (error, low) in enumerate(((0.0, 0.0), (0.4, 6.0))):
        x, y = low + 10.0 * rng.random(12000), 16.0 * rng.random(12000)
        look(mapper, flat(), x, y, rng, NOISE, make_pose(ABOVE, sigma, 1 + 10**9 * number), error)
    cells = mapper.snapshot()
    assert cells.measured.all()
    assert np.ptp(cells.z) < 0.05
    assert np.median(cells.z) == pytest.approx(0.2, abs=0.02)


def test_the_map_tells_how_far_navigation_is_from_it():
    """Whatever the map was lifted by: its height plus the offset is height by navigation."""
    rng, mapper = np.random.default_rng(7), mapper_of()
    fly(mapper, flat(), [0.0], rng)
    assert np.isnan(mapper.snapshot().offset_z), "nothing was compared yet"
    fly(mapper, flat(), np.zeros(3), rng, start=2.0)
    pose = make_pose(ABOVE, pose_covariance(0.3, 1e-9), 10**12)
    report = look(mapper, flat(), *scattered(rng, 0, 0, 16, 12000), rng, NOISE, pose, 0.3)
    assert report.offset == pytest.approx(0.3, abs=0.005)
    assert mapper.update(np.full((4, 3), np.nan), pose).offset == 0.0
    cells = mapper.snapshot()
    ground = np.median(cells.z[cells.measured])
    assert 0.05 < ground < 0.25, "navigation and map share the error"
    assert ground + cells.offset_z == pytest.approx(0.3, abs=0.02)
    assert 0.0 < cells.offset_variance < 0.1**2
    other = mapper_of()
    other.import_state(mapper.export_state())
    assert other.snapshot().offset_z == cells.offset_z
    mapper.reset()
    assert np.isnan(mapper.snapshot().offset_z)


@pytest.mark.parametrize("sigma", [0.05, 0.2])
@pytest.mark.parametrize("persistent", [False, True])
def test_the_maps_height_is_as_well_known_as_it_says(sigma, persistent):
    """Errors that are news each time and errors that last, over twelve flights each."""
    squares = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        errors = rng.normal(0.0, sigma, 1 if persistent else 60) * np.ones(60)
        mapper = mapper_of(300.0 if persistent else 0.0)
        fly(mapper, flat(), errors, rng, pose_covariance(sigma, 1e-9), points=1500)
        cells = mapper.snapshot()
        height = np.median(cells.z[cells.measured])
        squares.append(height**2 / np.median(cells.covariance_pose[cells.measured, 2, 2]))
    assert 0.02 < np.mean(squares) < 2.0


@pytest.mark.parametrize("share", [0.7, 0.5])
def test_a_scan_that_shows_less_of_each_leaf_tells_its_height_less_well(share):
    """Ground is no plane: what each of 16 leaves hides adds to the variance of the height."""
    config, variances = configured(levels=(2, 2), noise=0.01), []
    centres = 4.0 * np.stack(np.meshgrid(*[np.arange(4.0)] * 2)).reshape(2, 1, 16) + 2.0
    for width in (4.0, 4.0 * share):
        rng, mapper = np.random.default_rng(1), Mapper(config)
        for scan, wide in enumerate((4.0, width)):
            x, y = (centres + wide * (rng.random((2, 900, 16)) - 0.5)).reshape(2, -1)
            look(mapper, flat(), x, y, rng, 0.01, make_pose(stamp_ns=1 + 10**9 * scan))
        variances.append(mapper.snapshot().offset_variance)
    expected = config.vehicle.lengths.uneven * (1.0 / share**2 - 1.0) / 16.0
    # A share is counted as a little larger than it is, since points leave gaps by chance.
    assert 0.7 * expected < variances[1] - variances[0] < 1.05 * expected


@pytest.mark.parametrize("apart", [1.0, 50.0, 100.0, 300.0])
def test_pose_errors_stay_in_common_for_the_correlation_time(apart):
    """Of two scans with the same variance v, a correlation c leaves v (1 + c) / 2."""
    config = configured(levels=(3, 3), noise=0.001, pose={"correlation_time": 100.0})
    mapper, sigma = Mapper(config), pose_covariance(0.1, 1e-12)
    for seconds in (0.0, apart):
        pose = make_pose(ABOVE, sigma, 1 + round(1e9 * seconds))
        look(mapper, flat(), *lattice(0.0, 0.0, 16.0, 128), pose=pose)
    cells = mapper.snapshot()
    expected = 0.5 * 0.1**2 * (1.0 + np.exp(-apart / 100.0))
    np.testing.assert_allclose(cells.covariance_pose[:, 2, 2], expected, rtol=1e-3)
