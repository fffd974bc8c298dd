# SPDX-License-Identifier: Apache-2.0
"""Errors that are white, that persist and that are larger than claimed are told apart, by draws."""

import numpy as np
import pytest
from core.builders import configured, look
from core.scenes import flat, make_pose, pose_covariance, scattered

from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.mapping.pose_errors import LEAST, PoseErrors, Steps
from quadtree_lss.onboard.messages.intake import pose_notices

SIGMA, NOISE = 0.3, 0.01
DRAWS = 150
CAUTIOUS = (("white", 0.0), ("Gauss-Markov", 300.0), ("constant", 300.0))


def errors(rng: np.random.Generator, kind: str, rate: float, count: int) -> np.ndarray:
    """Errors (count,) of deviation SIGMA: white, constant, or Gauss-Markov of 100 s."""
    if kind == "constant":
        return np.full(count, SIGMA * rng.standard_normal())
    keep = 0.0 if kind == "white" else np.exp(-1.0 / (rate * 100.0))
    out = np.empty(count)
    state = rng.standard_normal()
    for k in range(count):
        out[k] = SIGMA * state
        state = keep * state + np.sqrt(1.0 - keep**2) * rng.standard_normal()
    return out


def judged(
    rng, kind, claimed_time, rate=20.0, scans=61, claimed=SIGMA, noise=NOISE
) -> PoseErrors | None:
    """What is said of a hover over ground that is their mean, as a filter would map it."""
    steps, ground = Steps(), 0.0
    found = errors(rng, kind, rate, scans)
    for k, error in enumerate(found):
        height = error - ground + noise * rng.standard_normal()
        mapped = claimed**2 if claimed_time else claimed**2 / max(k, 1)
        if k:
            steps.add(k / rate, height, claimed**2, mapped, noise**2, 0.0, claimed_time)
        ground += (error - ground) / (k + 1)
    return steps.judge()


TOLD = [
    ("white", 0.0, 1.0, 1.0, set()),
    ("white", 0.0, 20.0, 1.0, set()),
    ("Gauss-Markov", 100.0, 1.0, 1.0, set()),
    ("Gauss-Markov", 100.0, 20.0, 1.0, set()),
    ("Gauss-Markov", 300.0, 20.0, 1.0, set()),
    ("constant", 300.0, 1.0, 1.0, set()),
    # Half as much again and twice the errors, as navigation mostly claims.
    *((kind, time, 20.0, claimed, set()) for claimed in (1.5, 2.0) for kind, time in CAUTIOUS),
    ("white", 300.0, 20.0, 1.0, {"white"}),
    ("Gauss-Markov", 0.0, 20.0, 1.0, {"persist"}),
    ("constant", 0.0, 20.0, 1.0, {"persist"}),
    ("white", 0.0, 20.0, 0.25, {"too_small"}),
    ("white", 300.0, 20.0, 0.25, {"white", "too_small"}),
]


@pytest.mark.parametrize(("kind", "claimed_time", "rate", "claimed", "expected"), TOLD)
def test_what_is_not_as_claimed_is_told(kind, claimed_time, rate, claimed, expected):
    rng = np.random.default_rng(1)
    for _ in range(DRAWS):
        found = judged(rng, kind, claimed_time, rate, claimed=claimed * SIGMA)
        told = {name for name in ("white", "persist", "too_small") if getattr(found, name)}
        assert told == expected, found


def test_it_is_told_what_the_map_would_say():
    rng = np.random.default_rng(3)
    found = [judged(rng, "white", 300.0) for _ in range(DRAWS)]
    noisy = [judged(rng, "white", 300.0, noise=SIGMA) for _ in range(DRAWS)]
    for of in (found, noisy):  # the cells' own noise is none of theirs
        assert np.median([one.seen for one in of]) == pytest.approx(SIGMA, rel=0.1)
    assert np.median([one.white_says for one in found]) == pytest.approx(SIGMA / 61**0.5, rel=0.1)
    assert found[0].map_says == pytest.approx(SIGMA)
    (notice,) = pose_notices(found[0], configured())
    assert notice.text.startswith("poses look white") and "instead of 0.3" in notice.text
    lasting = judged(rng, "constant", 0.0)
    assert lasting.white_says == pytest.approx(SIGMA)
    (notice,) = pose_notices(lasting, configured(pose={"correlation_time": 0.0}))
    assert "persist" in notice.text


def test_single_wrong_poses_say_nothing_of_the_others():
    rng = np.random.default_rng(6)
    steps = Steps()
    for k in range(60):
        height = 0.01 * rng.standard_normal() + (50.0 if k % 7 == 3 else 0.0)
        steps.add(0.05 * k, height, SIGMA**2, SIGMA**2, NOISE**2, 0.0, 300.0)
    found = steps.judge()
    assert not (found.white or found.persist or found.too_small)


def test_little_is_not_judged():
    steps = Steps()
    for k in range(LEAST):
        assert steps.judge() is None
        steps.add(float(k), 0.0, 1.0, 1.0, 1e-4, 0.0, 300.0)
    assert steps.judge() is None
    steps.add(float(LEAST), 0.0, 1.0, 1.0, 1e-4, 0.0, 300.0)
    assert steps.judge() is not None
    assert not pose_notices(None, configured())


@pytest.mark.parametrize(
    ("kind", "claimed_time", "expected"),
    [
        ("white", 300.0, {"pose_white"}),
        ("white", 0.0, set()),
        ("constant", 0.0, {"pose_persist"}),
        ("Gauss-Markov", 100.0, set()),
    ],
)
def test_a_mapper_tells_of_a_hover(kind, claimed_time, expected):
    config = configured(levels=(4, 4), noise=0.02, pose={"correlation_time": claimed_time})
    mapper, rng = Mapper(config), np.random.default_rng(7)
    sigma = pose_covariance(SIGMA, 1e-3)
    for k, error in enumerate(errors(rng, kind, 20.0, 61)):
        pose = make_pose((8.0, 8.0, 100.0 + error), sigma, 50_000_000 * (k + 1))
        look(mapper, flat(), *scattered(rng, 0.0, 0.0, 16.0, 3000), rng, 0.02, pose, error)
    assert {notice.reason for notice in pose_notices(mapper.pose_errors(), config)} == expected
