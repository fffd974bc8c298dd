# SPDX-License-Identifier: Apache-2.0
"""A warning follows from heights that the poses' claims do not explain, and only from these."""

import numpy as np
import pytest
from core.builders import configured, look
from core.scenes import flat, make_pose, pose_covariance, scattered

from quadtree_lss.onboard.core.mapping.mapper import OFFSET_SCANS, Mapper
from quadtree_lss.onboard.messages.intake import pose_notice

CLAIM = 0.1


def hover(errors: np.ndarray, correlation_time: float) -> Mapper:
    """The mapper after a scan of level ground with each of these height errors, 20 a second."""
    pose = {"correlation_time": correlation_time}
    mapper = Mapper(configured(levels=(4, 4), noise=0.02, pose=pose))
    rng, sigma = np.random.default_rng(7), pose_covariance(CLAIM, 1e-3)
    for k, error in enumerate(errors):
        pose = make_pose((8.0, 8.0, 100.0 + error), sigma, 50_000_000 * (k + 1))
        look(mapper, flat(), *scattered(rng, 0.0, 0.0, 16.0, 3000), rng, 0.02, pose, error)
    return mapper


def drawn(size: float, persist: bool, scans: int) -> np.ndarray:
    """Errors of this standard deviation: one for all scans, or another one for each."""
    rng = np.random.default_rng(3)
    return np.full(scans, rng.normal(0.0, size)) if persist else rng.normal(0.0, size, scans)


@pytest.mark.parametrize("correlation_time", [0.0, 300.0])
@pytest.mark.parametrize("persist", [False, True])
def test_errors_as_large_as_claimed_give_no_warning(persist, correlation_time):
    mapper = hover(drawn(CLAIM, persist, 3 * OFFSET_SCANS), correlation_time)
    assert mapper.unexplained_offset() is None


@pytest.mark.parametrize("correlation_time", [0.0, 300.0])
def test_errors_ten_times_as_large_as_claimed_give_a_warning(correlation_time):
    mapper = hover(drawn(10.0 * CLAIM, False, 3 * OFFSET_SCANS), correlation_time)
    gap = mapper.unexplained_offset()
    assert gap is not None
    height, claimed = gap
    assert 3.0 * CLAIM < height < 30.0 * CLAIM and CLAIM <= claimed <= 2.0 * CLAIM
    notice = pose_notice(gap)
    assert notice is not None and "scans and map differ by" in notice.text
    mapper.reset()
    assert mapper.unexplained_offset() is None and pose_notice(None) is None


def test_single_wrong_poses_give_no_warning():
    errors = drawn(CLAIM, False, 3 * OFFSET_SCANS)
    errors[3::7] += 50.0
    assert hover(errors, 0.0).unexplained_offset() is None


def test_few_scans_give_no_warning():
    assert hover(drawn(10.0 * CLAIM, False, OFFSET_SCANS), 0.0).unexplained_offset() is None
