# SPDX-License-Identifier: Apache-2.0
"""Planes of cells from points: optimality, covariance by Monte Carlo, invariances, bad sets."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from core.builders import make_pose, moments_of, pose_covariance, scan, slope, unit_vectors
from hypothesis import given, settings
from hypothesis import strategies as st
from quadtree_lss.core.mapping.fitting import (
    Fit,
    SlopePrior,
    fit_scan,
    fit_scans,
    fittable,
    pool_scans,
)
from scipy.optimize import minimize

from quadtree_lss.config.settings import MappingConfig
from quadtree_lss.core.geometry import planes, rotations, sphere
from quadtree_lss.core.geometry.planes import Moments

HEIGHT = MappingConfig(fit="height")
ML = MappingConfig(fit="ml")
UP = np.array([0.0, 0.0, 1.0])
LIDAR = np.array([30.0, -20.0, 80.0])
NO_POSE = np.zeros((6, 6))
GRADIENT = (0.15, -0.08)
NORMAL = np.array([-GRADIENT[0], -GRADIENT[1], 1.0]) / np.sqrt(1.0 + np.sum(np.square(GRADIENT)))
TRIALS = 5000
#: Side of the one cell of a test, m.
SIZE = np.array([2.0])


def no_prior(cells: int) -> SlopePrior:
    return SlopePrior(np.tile(UP, (cells, 1)), np.zeros(cells))


def one(points: np.ndarray, lidar: np.ndarray = LIDAR) -> Moments:
    """Moments of one group from points (N, 3)."""
    return moments_of(np.zeros(len(points), dtype=np.intp), 1, points, lidar)


def trials(
    rng: np.random.Generator, count: int, noise: float, centre: tuple[float, float], size: float
) -> np.ndarray:
    """``count`` points in each of TRIALS looks at one plane: (T N, 3)."""
    offset = rng.uniform(-0.5 * size, 0.5 * size, (2, TRIALS * count))
    x, y = centre[0] + offset[0], centre[1] + offset[1]
    truth = np.stack([x, y, GRADIENT[0] * x + GRADIENT[1] * y])
    ray = truth - LIDAR[:, None]
    ray /= np.linalg.norm(ray, axis=0)
    return (truth + noise * rng.standard_normal(len(x)) * ray).T


def error_of(fit: Fit, centre: np.ndarray) -> np.ndarray:
    """(T, 3) errors of fits about (centre, fit.z) against the plane through the origin."""
    origin = np.column_stack([np.broadcast_to(centre, (len(fit.z), 2)), fit.z])
    truth = np.tile(NORMAL, (len(fit.z), 1))
    return np.column_stack([sphere.minus(fit.planes.normal, truth), origin @ NORMAL])


def assert_consistent(error: np.ndarray, covariance: np.ndarray, slack: float = 0.0) -> None:
    """Sample against predicted covariance, entry by entry, and the mean NEES against 3.

    A sample covariance of T draws errs by sqrt(2 / T) relative, NEES by sqrt(2 * 3 / T).
    """
    expected = covariance.mean(axis=0)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    found = error.T @ error / len(error)
    assert (np.abs(found - expected) <= (5.0 * np.sqrt(2.0 / len(error)) + slack) * scale).all()
    nees = np.einsum("mi,mij,mj->m", error, np.linalg.inv(covariance), error)
    assert abs(nees.mean() - 3.0) < 5.0 * np.sqrt(6.0 / len(error)) + 3.0 * slack


@pytest.mark.parametrize("config", [HEIGHT, ML], ids=["height", "ml"])
@pytest.mark.parametrize(
    ("middle", "centre"), [((4.0, 3.0), (4.0, 3.0)), ((4.0, 3.0), (4.8, 2.1))], ids=["on", "off"]
)
def test_range_noise_covariance_against_monte_carlo(config, middle, centre):
    """Also with the cell's centre away from the points' centroid."""
    rng = np.random.default_rng(1)
    points = trials(rng, 40, 0.02, middle, 2.0)
    moment = moments_of(np.repeat(np.arange(TRIALS), 40), TRIALS, points, LIDAR)
    at = np.tile(centre, (TRIALS, 1))
    fit = fit_scan(moment, at, no_prior(TRIALS), config, 0.02, LIDAR, NO_POSE)
    assert not fit.planes.pose_part.any()
    # The paper's 1 / (N - 0) weights are exact; the tilt's own scatter is a relative 1/40.
    assert_consistent(error_of(fit, np.array(centre)), fit.planes.range_part, 0.02)


@pytest.mark.parametrize("noise", [1e-5, 0.03], ids=["pose only", "pose and range"])
@pytest.mark.parametrize("config", [HEIGHT, ML], ids=["height", "ml"])
def test_common_pose_error_against_monte_carlo(config, noise):
    """Each look has a pose error of its own, common to its points: it does not average out."""
    rng = np.random.default_rng(2)
    points = trials(rng, 25, noise, (4.0, 3.0), 2.0)
    covariance = pose_covariance(0.05, 4e-4)
    covariance[0, 4] = covariance[4, 0] = 0.7 * 0.05 * 4e-4
    error = rng.multivariate_normal(np.zeros(6), covariance, TRIALS)
    group = np.repeat(np.arange(TRIALS), 25)
    turn = rotations.exp(error[:, 3:])[group]
    points = (turn @ (points - LIDAR)[:, :, None])[:, :, 0] + LIDAR + error[group, :3]
    moment = moments_of(group, TRIALS, points, LIDAR)
    centre = np.tile([4.5, 2.5], (TRIALS, 1))
    fit = fit_scan(
        moment, centre, no_prior(TRIALS), config, noise, LIDAR, planes.covariance_root(covariance)
    )
    total = fit.planes.range_part + fit.planes.pose_part
    assert_consistent(error_of(fit, centre[0]), total, 0.02)


def test_independent_treatment_averages_the_pose_out():
    """The paper's: every point as uncertain as range and pose together make it, no pose part."""
    rng = np.random.default_rng(3)
    points = trials(rng, 40, 0.02, (4.0, 3.0), 2.0)
    moment = moments_of(np.repeat(np.arange(TRIALS), 40), TRIALS, points, LIDAR)
    centre = np.tile([4.0, 3.0], (TRIALS, 1))
    root = planes.covariance_root(pose_covariance(0.3, 0.0))
    config = dataclasses.replace(HEIGHT, covariance="independent")
    alone = fit_scan(moment, centre, no_prior(TRIALS), config, 0.02, LIDAR, NO_POSE)
    both = fit_scan(moment, centre, no_prior(TRIALS), config, 0.02, LIDAR, root)
    np.testing.assert_array_equal(both.planes.normal, alone.planes.normal)
    assert not both.planes.pose_part.any()
    variance = 0.3**2  # of n.dm
    added = both.planes.range_part[:, 2, 2] - alone.planes.range_part[:, 2, 2]
    assert (added >= 0.99 * variance / 40).all()
    mean = np.mean(added)
    assert mean == pytest.approx(variance / 40, rel=0.1)


def two_scans(rng: np.random.Generator) -> tuple[list[np.ndarray], np.ndarray]:
    """Clouds of one plane seen from two places, their heights half a metre apart."""
    lidars = np.array([[30.0, -20.0, 80.0], [-60.0, 30.0, 90.0]])
    clouds = []
    for count, offset, lidar in ((20, 0.25, lidars[0]), (9, -0.25, lidars[1])):
        x, y = rng.uniform(-1.0, 1.0, (2, count))
        truth = np.column_stack([x, y, GRADIENT[0] * x + GRADIENT[1] * y + offset])
        ray = truth - lidar
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        clouds.append(truth + 0.02 * rng.standard_normal(count)[:, None] * ray)
    return clouds, lidars


def joined(parts: list[Moments]) -> Moments:
    """Groups of several moments one after the other."""
    names = [field.name for field in dataclasses.fields(Moments)]
    return Moments(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def pooled(clouds: list[np.ndarray], lidars: np.ndarray) -> Moments:
    return joined([one(c, at) for c, at in zip(clouds, lidars, strict=True)])


def fit_both(clouds, lidars, config=ML, noise=0.02) -> tuple[Fit | None, bool]:
    """Fit of one cell to scans, or None and False where they do not suffice."""
    moment, cell = pooled(clouds, lidars), np.zeros(len(clouds), dtype=np.intp)
    of_cell, _, enough = pool_scans(moment, cell, 1, config.min_points)
    if not (fittable(of_cell, SIZE, no_prior(1), config, noise) & enough)[0]:
        return None, False
    scan_of, poses = np.arange(len(clouds)), np.zeros((len(clouds), 6, 6))
    fit = fit_scans(
        moment, cell, scan_of, np.zeros((1, 2)), no_prior(1), config, noise, lidars, poses
    )
    return fit, True


def test_several_scans_minimise_the_weighted_cost():
    """Eq. 25 with its erratum: weights 1 / (n' Sigma n), one free offset per scan (Eq. 21)."""
    clouds, lidars = two_scans(np.random.default_rng(4))
    fit, good = fit_both(clouds, lidars)
    assert good
    found = fit.planes.normal[0]
    rays = pooled(clouds, lidars).ray
    weight = 1.0 / (0.02 * (rays @ found)) ** 2

    def cost(state: np.ndarray) -> float:
        n = sphere.plus(found, state[:2])
        return 0.5 * sum(
            w * np.sum((cloud @ n - g) ** 2)
            for w, cloud, g in zip(weight, clouds, state[2:], strict=True)
        )

    gamma = [cloud.mean(axis=0) @ found for cloud in clouds]
    best = minimize(cost, np.concatenate([np.zeros(2), gamma]), options={"gtol": 1e-9})
    sigma = np.sqrt(fit.planes.range_part[0, [0, 1], [0, 1]])
    # Optimal to well under the fit's own uncertainty.
    assert (np.abs(best.x[:2]) < 1e-3 * sigma).all()


@pytest.mark.parametrize("pose_scale", [1e-6, 1.0], ids=["range only", "pose and range"])
@pytest.mark.parametrize("config", [HEIGHT, ML], ids=["height", "ml"])
def test_covariance_of_several_scans_against_monte_carlo(config, pose_scale):
    """Two scans of 12 and 8 points in each of TRIALS cells, each scan with its own pose error."""
    rng = np.random.default_rng(11)
    lidars = np.array([[30.0, -20.0, 80.0], [-60.0, 30.0, 90.0]])
    covariances = np.array([pose_covariance(0.05, 3e-4), pose_covariance(0.02, 6e-4)])
    covariances *= pose_scale**2
    parts = []
    for lidar, covariance, count in zip(lidars, covariances, (12, 8), strict=True):
        group = np.repeat(np.arange(TRIALS), count)
        x, y = rng.uniform(-1.0, 1.0, (2, len(group)))
        truth = np.column_stack([x, y, GRADIENT[0] * x + GRADIENT[1] * y])
        arm = truth - lidar
        arm *= (1.0 + 0.02 * rng.standard_normal(len(x)) / np.linalg.norm(arm, axis=1))[:, None]
        error = rng.multivariate_normal(np.zeros(6), covariance, TRIALS)
        seen = (rotations.exp(error[:, 3:])[group] @ arm[:, :, None])[:, :, 0]
        parts.append(moments_of(group, TRIALS, seen + lidar + error[group, :3], lidar))
    fit = fit_scans(
        joined(parts),
        np.tile(np.arange(TRIALS), 2),
        np.repeat([0, 1], TRIALS),
        np.zeros((TRIALS, 2)),
        no_prior(TRIALS),
        config,
        0.02,
        lidars,
        planes.covariance_root(covariances),
    )
    error = error_of(fit, np.zeros(2))
    told = np.einsum("mii->mi", fit.planes.range_part + fit.planes.pose_part).mean(axis=0)
    # The points weigh the scans' pose errors of the slope by their number, the covariance
    # evenly: a matter of hundredths here, where range noise decides the slope.
    slack = 5.0 * np.sqrt(2.0 / TRIALS) + 0.03
    np.testing.assert_allclose(np.mean(error**2, axis=0) / told, 1.0, atol=slack)


@pytest.mark.parametrize("config", [HEIGHT, ML], ids=["height", "ml"])
def test_offsets_between_scans_do_not_tilt_the_plane(config):
    """gamma_j takes a scan's pose error: moving one scan as a whole leaves the normal alone."""
    clouds, lidars = two_scans(np.random.default_rng(5))
    before, _ = fit_both(clouds, lidars, config)
    moved = [clouds[0], clouds[1] + (0.0, 0.0, 7.0)]
    after, _ = fit_both(moved, lidars + np.array([[0.0, 0, 0], [0.0, 0, 7.0]]), config)
    np.testing.assert_allclose(after.planes.normal, before.planes.normal, atol=1e-12)
    # d is the mean of the offsets (Eq. 22): half of the move.
    assert after.z[0] - before.z[0] == pytest.approx(3.5, abs=1e-9)


def test_one_stored_scan_is_the_same_as_one_scan():
    clouds, lidars = two_scans(np.random.default_rng(6))
    for config in (HEIGHT, ML):
        alone = fit_scan(
            one(clouds[0], lidars[0]),
            np.zeros((1, 2)),
            no_prior(1),
            config,
            0.02,
            lidars[0],
            NO_POSE,
        )
        stored, good = fit_both(clouds[:1], lidars[:1], config)
        assert good
        np.testing.assert_allclose(stored.planes.normal, alone.planes.normal, atol=1e-12)
        np.testing.assert_allclose(stored.z, alone.z, atol=1e-12)
        np.testing.assert_allclose(stored.planes.range_part, alone.planes.range_part, rtol=1e-9)


@pytest.mark.parametrize("config", [HEIGHT, ML], ids=["height", "ml"])
def test_order_of_points_and_place_of_the_origin_do_not_matter(config):
    rng = np.random.default_rng(7)
    cloud = two_scans(rng)[0][0]
    root = planes.covariance_root(pose_covariance(0.1, 1e-3))

    def fitted(points, centre, lidar):
        return fit_scan(one(points, lidar), centre, no_prior(1), config, 0.02, lidar, root)

    base = fitted(cloud, np.zeros((1, 2)), LIDAR)
    shuffled = fitted(cloud[rng.permutation(len(cloud))], np.zeros((1, 2)), LIDAR)
    shift = np.array([70.0, -30.0, 20.0])
    shifted = fitted(cloud + shift, shift[None, :2], LIDAR + shift)
    np.testing.assert_allclose(shifted.z - shift[2], base.z, atol=1e-9)
    np.testing.assert_allclose(shuffled.z, base.z, atol=1e-12)
    for other in (shuffled, shifted):
        np.testing.assert_allclose(other.planes.normal, base.planes.normal, atol=1e-9)
        np.testing.assert_allclose(other.planes.range_part, base.planes.range_part, rtol=1e-6)
        np.testing.assert_allclose(other.planes.pose_part, base.planes.pose_part, atol=1e-9)


@pytest.mark.parametrize("config", [HEIGHT, ML], ids=["height", "ml"])
def test_a_turn_about_the_vertical_turns_the_fit(config):
    """Eq. 2's basis turns along: R_(Qn) = Q R_n Q^T for Q about z."""
    cloud = two_scans(np.random.default_rng(8))[0][0]
    turn = rotations.exp(np.array([0.0, 0.0, 0.7]))
    root = planes.covariance_root(pose_covariance(0.1, 1e-3))
    centre = np.array([[0.3, -0.2]])
    base = fit_scan(one(cloud), centre, no_prior(1), config, 0.02, LIDAR, root)
    turned = fit_scan(
        one(cloud @ turn.T, turn @ LIDAR),
        centre @ turn[:2, :2].T,
        no_prior(1),
        config,
        0.02,
        turn @ LIDAR,
        root,
    )
    full = np.eye(3)
    full[:2, :2] = turn[:2, :2]
    np.testing.assert_allclose(turned.planes.normal[0], turn @ base.planes.normal[0], atol=1e-9)
    np.testing.assert_allclose(turned.z, base.z, atol=1e-9)
    for name in ("range_part", "pose_part"):
        before, after = getattr(base.planes, name)[0], getattr(turned.planes, name)[0]
        np.testing.assert_allclose(after, full @ before @ full.T, atol=1e-9 * before.max())


def test_a_prior_pulls_the_slope_and_its_weight_is_in_points():
    """A prior worth as much scatter as the points have goes half way (height fit)."""
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 5), np.linspace(-1.0, 1.0, 5))
    cloud = np.column_stack([x.ravel(), y.ravel(), 0.2 * x.ravel()])
    spread = np.array([np.sum(x**2)])
    prior = SlopePrior(UP[None], spread)
    fit = fit_scan(one(cloud), np.zeros((1, 2)), prior, HEIGHT, 0.02, LIDAR, NO_POSE)
    normal = fit.planes.normal[0]
    assert -normal[0] / normal[2] == pytest.approx(0.1, abs=1e-12)
    assert normal[1] == pytest.approx(0.0, abs=1e-12)


def sets_of_points() -> st.SearchStrategy[np.ndarray]:
    """Clouds of every kind: scattered, on a line, on a wall, one point many times, very few."""

    def build(kind: str, count: int, seed: int, scale: float) -> np.ndarray:
        rng = np.random.default_rng(seed)
        cloud = scale * rng.standard_normal((count, 3))
        if kind == "line":
            cloud = np.outer(cloud[:, 0], unit_vectors(rng, 1)[0])
        elif kind == "wall":
            cloud[:, 0] = 1e-9 * cloud[:, 0]
        elif kind == "one place":
            cloud = np.tile(cloud[:1], (count, 1))
        elif kind == "two places":
            cloud = cloud[rng.integers(0, min(2, count), count)]
        elif kind == "vertical line":
            cloud[:, :2] = cloud[:1, :2]
        elif kind == "level":
            cloud[:, 2] = 0.0
        return cloud

    kinds = ["scattered", "line", "wall", "one place", "two places", "vertical line", "level"]
    return st.builds(
        build,
        st.sampled_from(kinds),
        st.integers(1, 12),
        st.integers(0, 10_000),
        st.sampled_from([1e-6, 1e-2, 0.5, 100.0]),
    )


@settings(deadline=None, max_examples=300)
@given(sets_of_points(), st.sampled_from([HEIGHT, ML]), st.sampled_from([0.0, 0.3]))
def test_what_is_called_fittable_gives_a_sound_plane(cloud, config, spread):
    prior = SlopePrior(UP[None], np.array([spread if config.fit == "height" else 0.0]))
    moment = one(cloud)
    if not fittable(moment, SIZE, prior, config, 0.05)[0]:
        return
    root = planes.covariance_root(pose_covariance(0.1, 1e-3))
    fit = fit_scan(moment, np.zeros((1, 2)), prior, config, 0.05, LIDAR, root)
    assert fit.planes.normal[0, 2] > 0.0
    assert np.linalg.norm(fit.planes.normal[0]) == pytest.approx(1.0, abs=1e-9)
    for values in (fit.z, fit.noise, fit.planes.range_part, fit.planes.pose_part):
        assert np.isfinite(values).all()
    assert np.linalg.eigvalsh(fit.planes.range_part[0]).min() > 0.0


@pytest.mark.parametrize("fit", ["height", "ml"])
@pytest.mark.parametrize(
    "cloud",
    [
        np.zeros((1, 3)),
        np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
        np.tile([[0.3, 0.2, 0.1]], (50, 1)),
        np.column_stack([np.linspace(0, 1, 50), np.linspace(0, 1, 50), np.zeros(50)]),
        np.column_stack([np.zeros(50), np.zeros(50), np.linspace(0, 1, 50)]),
    ],
    ids=["one", "two", "duplicates", "line", "vertical line"],
)
def test_degenerate_sets_are_not_fittable(cloud, fit):
    config = MappingConfig(fit=fit)
    assert not fittable(one(cloud), SIZE, no_prior(1), config, 0.05)[0]
    _, good = fit_both([cloud], LIDAR[None], config, noise=0.05)
    assert not good


@pytest.mark.parametrize("fit", ["height", "ml"])
def test_points_of_a_full_cell_are_fittable(fit):
    rng = np.random.default_rng(10)
    cloud = np.column_stack([rng.uniform(-1.0, 1.0, (50, 2)), 0.02 * rng.standard_normal(50)])
    assert fittable(one(cloud), SIZE, no_prior(1), MappingConfig(fit=fit), 0.05)[0]


def test_a_strip_is_too_narrow_only_for_noise_that_crosses_it():
    """A tenth of a metre wide along y, seen from above and from the side."""
    rng = np.random.default_rng(2)
    x, y = 0.1 * rng.standard_normal(400), rng.uniform(-1.0, 1.0, 400)
    cloud = np.column_stack([x, y, np.zeros(400)])
    for lidar, sound in (((0.0, 0.0, 500.0), True), ((-500.0, 0.0, 500.0), False)):
        moment = one(cloud, np.array(lidar))
        assert fittable(moment, SIZE, no_prior(1), MappingConfig(), 0.05)[0] == sound


def test_three_spread_points_are_fittable_and_exact():
    cloud = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.3], [0.0, 2.0, -0.2]])
    for config in (HEIGHT, ML):
        assert fittable(one(cloud), SIZE, no_prior(1), config, 0.05)[0]
        fit = fit_scan(one(cloud), np.zeros((1, 2)), no_prior(1), config, 0.05, LIDAR, NO_POSE)
        offset = (cloud - (0.0, 0.0, fit.z[0])) @ fit.planes.normal[0]
        np.testing.assert_allclose(offset, 0.0, atol=1e-12)


def test_many_cells_at_once_are_as_one_by_one():
    rng = np.random.default_rng(9)
    pose = make_pose(tuple(LIDAR))
    group = np.repeat(np.arange(7), 15)
    x, y = rng.uniform(-1.0, 1.0, (2, 105))
    points = scan(slope(*GRADIENT), x, y, pose, 0.05, rng) @ pose.rotation_map_lidar.T + LIDAR
    centre = rng.uniform(-1.0, 1.0, (7, 2))
    together = fit_scan(
        moments_of(group, 7, points, LIDAR), centre, no_prior(7), ML, 0.05, LIDAR, NO_POSE
    )
    for k in range(7):
        alone = fit_scan(
            one(points[group == k]), centre[[k]], no_prior(1), ML, 0.05, LIDAR, NO_POSE
        )
        np.testing.assert_allclose(together.planes.normal[k], alone.planes.normal[0], atol=1e-12)
        np.testing.assert_allclose(together.z[k], alone.z[0], atol=1e-12)
        np.testing.assert_allclose(
            together.planes.range_part[k], alone.planes.range_part[0], rtol=1e-9
        )
