# SPDX-License-Identifier: Apache-2.0
"""What the points of one scan in a cell say: optimality, covariance by Monte Carlo, invariances."""

from typing import NamedTuple

import numpy as np
import pytest
from core.builders import configured, look
from core.kernels import fit, tangent_basis
from core.scenes import flat, lattice, pose_covariance
from scipy.stats import chi2

from quadtree_lss.onboard.core.geometry import rotations
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.mapping.measure import Rules

UP = np.array([0.0, 0.0, 1.0])
LIDAR = np.array([30.0, -20.0, 80.0])
NO_POSE = np.zeros((6, 6))
GRADIENT = (0.15, -0.08)
NORMAL = np.array([-GRADIENT[0], -GRADIENT[1], 1.0]) / np.sqrt(1.0 + np.sum(np.square(GRADIENT)))
FITS = pytest.mark.parametrize("method", ["none", "fit"])


def rules(method: str = "none", noise: float = 0.02, **mapping: object) -> Rules:
    values = {"paper": method, **mapping}
    return Rules(configured(mapping=values, noise=noise))


class Found(NamedTuple):
    """A fit in map axes: `measure` works about the lidar."""

    normal: np.ndarray
    z: float
    range_part: np.ndarray
    pose_part: np.ndarray
    unseen: float
    alone: float
    own: float
    lever: np.ndarray

    @property
    def total(self) -> np.ndarray:
        return self.range_part + self.pose_part


def fitted(
    of: Rules,
    points: np.ndarray,
    centre: tuple[float, float] = (0.0, 0.0),
    side: float = 2.0,
    sigma: np.ndarray = NO_POSE,
    lidar: np.ndarray = LIDAR,
    prior: np.ndarray = UP,
) -> Found:
    run = fit(of, points - lidar, *(np.array(centre) - lidar[:2]), side, prior, sigma)[0]
    parts = run.range_part.reshape(3, 3), run.pose_part.reshape(3, 3)
    rest = run.unobserved, run.height_only, run.mean_variance, run.lever
    return Found(run.normal, run.z + lidar[2], *parts, *rest)


def tilted(rng: np.random.Generator, per_side: int, noise: float) -> np.ndarray:
    """Points (N, 3) of the tilted plane through the origin, one somewhere in each of the squares
    that fill a cell: nothing of it is left out."""
    corner = np.stack(np.meshgrid(*[np.arange(per_side)] * 2), axis=-1).reshape(-1, 2)
    x, y = ((corner + rng.random(corner.shape)) / per_side - 0.5).T * 2.0
    truth = np.stack([x, y, GRADIENT[0] * x + GRADIENT[1] * y], axis=1)
    ray = truth - LIDAR
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return truth + noise * rng.standard_normal((len(x), 1)) * ray


@FITS
def test_a_turn_about_the_vertical_turns_the_fit(method):
    """Eq. 2's basis turns along: R_(Qn) = Q R_n Q^T for Q about z."""
    cloud, sigma = tilted(np.random.default_rng(8), 5, 0.02), pose_covariance(0.1, 1e-3)
    turn = rotations.exp(np.array([0.0, 0.0, 0.5 * np.pi]))  # keeps the cell's sides
    centre = np.array([0.3, -0.2, 0.0])
    by = rules(method)
    base = fitted(by, cloud, tuple(centre[:2]), sigma=sigma)
    turned = fitted(by, cloud @ turn.T, tuple((turn @ centre)[:2]), sigma=sigma, lidar=turn @ LIDAR)
    full = np.eye(3)
    full[:2, :2] = turn[:2, :2]
    np.testing.assert_allclose(turned.normal, turn @ base.normal, atol=1e-9)
    assert turned.z == pytest.approx(base.z, abs=1e-9)
    for name in ("range_part", "pose_part"):
        before, after = getattr(base, name), getattr(turned, name)
        np.testing.assert_allclose(after, full @ before @ full.T, atol=1e-9 * before.max())


def test_where_points_tell_no_slope_the_prior_is_kept_and_called_unknown():
    prior = np.array([0.3, 0.2, 1.0]) / np.sqrt(1.13)
    for cloud in (np.zeros((1, 3)), np.tile([[0.3, 0.2, 0.1]], (50, 1))):
        found = fitted(rules(), cloud, prior=prior)
        np.testing.assert_allclose(found.normal, prior, atol=1e-9)
        assert found.alone


@pytest.mark.parametrize("middle", [0.0, 0.9])
@pytest.mark.parametrize("width", [0.0, 0.1, 0.3])
def test_a_strip_tells_its_height_alone(middle, width):
    """At 45 degrees noise moves points in x as it does in z, which would turn a narrow fit."""
    rng, lidar, by = np.random.default_rng(11), np.array([-300.0, 0.0, 300.0]), rules(noise=0.05)
    prior = np.array([0.1, -0.05, 1.0]) / np.sqrt(1.0125)
    truth = rng.uniform(-1.0, 1.0, (400, 3)) * (0.5 * width, 1.0, 0.0) + (middle, 0.0, 0.0)
    ray = (truth - lidar) / np.linalg.norm(truth - lidar, axis=1, keepdims=True)
    seen = truth + 0.05 * rng.standard_normal((400, 1)) * ray
    found = fitted(by, seen, lidar=lidar, prior=prior)
    np.testing.assert_array_equal(found.normal, prior)
    assert found.alone
    # Where the points are, the plane lies at their mean height.
    at = seen.mean(axis=0)
    over = found.z - (prior[0] * at[0] + prior[1] * at[1]) / prior[2]
    assert over == pytest.approx(at[2], abs=1e-9)
    lever = (at - (0.0, 0.0, found.z)) @ tangent_basis(prior)
    np.testing.assert_allclose(found.lever, lever, atol=1e-9)
    assert np.sqrt(found.own) < 0.2


def test_noise_of_stereo_goes_with_the_square_of_the_depth():
    """And is common to range and depth by the angle between them: seen from beside, too."""
    of = Rules(configured(lidar={"range_noise": 0.02, "stereo_noise": 0.1 / 20.0}))
    cloud, given = tilted(np.random.default_rng(13), 7, 0.0), (2.0, NORMAL, NO_POSE)
    for up, aside in ((2.0, 0.0), (8.0, 0.0), (8.0, 8.0)):
        found = fit(of, cloud + (aside, 0.0, -up), aside, 0.0, *given)[0]
        z, distance = -found.centroid[2], np.linalg.norm(np.array(found.centroid))
        along = np.hypot(0.02, 0.1 * z * distance / 20.0)
        assert np.sqrt(found.variance) == pytest.approx(along * found.cosine, rel=1e-6)


def test_points_as_far_apart_in_height_as_in_place_are_no_upright_plane():
    """There ml keeps to the regression of height."""
    cloud = np.random.default_rng(16).standard_normal((200, 3)) * (0.4, 0.4, 2.0)
    height, ml = (fitted(rules(method), cloud) for method in ("none", "fit"))
    np.testing.assert_array_equal(ml.normal, height.normal)


@pytest.mark.parametrize("part", [(0.0, 1.5, 0.0, 4.0), (1.0, 4.0, 2.5, 4.0), (0.0, 2.0, 0.0, 2.0)])
def test_a_height_is_known_best_in_the_middle_of_what_was_seen(part):
    """However little of the leaf that is, and wherever; far from it the slope makes it worse."""
    config = configured(levels=(2, 6), noise=0.01)
    mapper, (x, y) = Mapper(config), lattice(0.0, 0.0, 4.0, 160)
    west, east, south, north = part
    here = (x > west) & (x < east) & (y > south) & (y < north)
    for _ in range(5):
        look(mapper, flat(), x[here], y[here])
    cells = mapper.snapshot()
    assert cells.measured.sum() == 1
    at = np.arange(0.125, 4.0, 0.25)
    deviation = cells.at(at[None, :], at[:, None]).deviation
    row, column = np.unravel_index(deviation.argmin(), deviation.shape)
    assert abs(at[column] - 0.5 * (west + east)) < 0.26
    assert abs(at[row] - 0.5 * (south + north)) < 0.26
    assert deviation.max() > 3.0 * deviation.min()


@pytest.mark.parametrize(("deviations", "misfit"), [(1.9, False), (2.1, True)])
@pytest.mark.parametrize("per_side", [3, 5, 20])
def test_residuals_beyond_two_deviations_of_their_mean_square_are_misfit(
    per_side, deviations, misfit
):
    """Of noise the mean square of N - 3 free residuals is a chi-square over N - 3."""
    cloud, given = tilted(np.random.default_rng(17), per_side, 0.02), (2.0, NORMAL, NO_POSE)
    of, free = chi2(per_side**2 - 3), per_side**2 - 3
    run = fit(rules(), cloud - LIDAR, *-LIDAR[:2], *given)[0]
    most = 1.0 + deviations * of.std() / free
    noise = np.sqrt(run.square / most) / run.cosine
    run = fit(rules(noise=noise), cloud - LIDAR, *-LIDAR[:2], *given)[0]
    assert run.square / run.variance == pytest.approx(most, rel=1e-3)
    excess = run.mean_variance - run.variance / per_side**2
    assert (excess > 1e-3 * run.variance) == misfit


def test_what_the_parents_plane_left_out_makes_the_unseen_half_less_certain():
    """A tilt of the mean square ``uneven`` over the cell, about the middle of what was seen."""
    mapper, (x, y) = Mapper(configured(levels=(2, 6), noise=0.01)), lattice(0.0, 0.0, 4.0, 160)
    look(mapper, flat(), x[x < 2.0], y[x < 2.0])
    x, y = np.meshgrid(*[np.linspace(0.1, 3.9, 9)] * 2)
    before, uneven = mapper.snapshot().at(x, y).deviation, 0.02
    mapper.leaves.rows.parent_misfit[mapper.leaves.rows.state == 3] = uneven
    after = mapper.snapshot().at(x, y).deviation
    unseen, tilt = 0.5, 12.0 * uneven / 4.0**2
    expected = unseen**2 * tilt * ((x - 1.0) ** 2 + (y - 2.0) ** 2)
    np.testing.assert_allclose(after**2 - before**2, expected, rtol=0.02)
