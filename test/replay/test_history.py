# SPDX-License-Identifier: Apache-2.0
"""``history.npz``: bounded, in order, and what the scans and answers said."""

import numpy as np
import pytest
from replay.recordings import GROUND, write_ros2

from quadtree_lss.desk.replay.assessments import Thinned
from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.core.landing.hazards import UNSEEN


def test_of_many_some_stay_evenly_and_the_last():
    thinned = Thinned(8)
    for number in range(1000):
        thinned.add(number)
        kept = thinned.all()
        assert len(kept) <= 9 and kept[0] == 0 and kept[-1] == number
    assert set(np.diff(kept[:-1])) == {128}


@pytest.mark.slow
def test_it_tells_where_the_lidar_was_and_looked(tmp_path):
    config = config_from_values(GROUND)
    result = replay(write_ros2(tmp_path / "bag"), tmp_path / "out", config)
    with np.load(tmp_path / "out" / "history.npz") as history:
        stamps = [row.stamp_ns for row in result.timings]
        np.testing.assert_array_equal(history["scan_stamp_ns"], stamps)
        # The scans look down: their outlines lie about the places below them.
        outline, below = history["scan_outline"], history["scan_position"][:, :2]
        assert outline.shape == (len(stamps), 12, 2)
        half = config.domain.size
        assert np.all(np.abs(outline.mean(axis=1) - below) < half)
        shape = result.assessment.hazard.shape
        bits = np.unpackbits(history["seen"], axis=1, count=shape[0] * shape[1]) > 0
        # What is known grows, though not everywhere: a leaf that divides may have to be seen again.
        assert bits[-1].sum() > bits[0].sum()
        seen = result.assessment.hazard & UNSEEN == 0
        np.testing.assert_array_equal(bits[-1].reshape(shape), seen)
        allowed = np.unpackbits(history["allowed"][-1], count=shape[0] * shape[1]) > 0
        np.testing.assert_array_equal(allowed.reshape(shape), result.assessment.safe)
        kept = history["risk"][-1].reshape(shape)
        risk = np.maximum(result.assessment.risk, 1e-4)
        np.testing.assert_allclose(10.0 ** (kept[seen] / -60.0), risk[seen], rtol=0.02)
        assert np.all((history["risk"] < 255) == bits)
        last = history["site_answer"] == len(history["answer_stamp_ns"]) - 1
        np.testing.assert_allclose(history["site_position"][last], result.assessment.sites.position)
        assert history["target"][-1, 0] == result.assessment.selected.id
        assert history["target"][-1, 4] == result.assessment.selected.probability
        assert history["target_why"][-1] == result.assessment.why
