# SPDX-License-Identifier: Apache-2.0
"""Consistency of maps over simulated bags."""

import pytest
from replay.recordings import write_ros2

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.lab.evaluation.consistency import Consistency, consistency
from quadtree_lss.lab.evaluation.prefit import Counts
from quadtree_lss.lab.evaluation.results import EvaluationError
from quadtree_lss.lab.simulation.simulate import simulate

SMALL = {
    "domain.xmin": -30.0,
    "domain.ymin": -30.0,
    "domain.size": 60.0,
    "domain.min_level": 3,
    "domain.max_level": 4,
    "lidar.range_noise": 0.03,
}


@pytest.fixture(scope="module")
def parabola(tmp_path_factory):
    """The first scans of Section VI's flight, three seeds."""
    folder = tmp_path_factory.mktemp("parabola")
    return [
        simulate("parabola", folder / f"{seed}", seed=seed, duration=12.0, truth=False).bag_path
        for seed in (201, 202, 203)
    ]


def test_section_vi_is_consistent_with_its_seeds_pooled(parabola):
    """39 poses, each of which moves a whole scan: the shares are known to a few per cent."""
    config = load_config(["parabola"])
    parts = [consistency(bag, config) for bag in parabola]
    assert sum(part.scans for part in parts) == 39
    together = sum((part.counts for part in parts), Counts())
    below, above = together.one_degree
    assert below < 0.1
    assert above < 0.1
    assert together.three_degrees.below > 0.15


def test_a_wrong_range_noise_is_seen(tmp_path):
    """Poses are nearly exact, so the residuals are the range noise's, a third of the assumed."""
    bag = write_ros2(tmp_path / "bag")
    seen: list[int] = []
    found = consistency(bag, load_config((), SMALL), progress=seen.append)
    assert seen == list(range(1, found.scans + 1))
    right = found.counts
    # Leaves that were seen in part claim more than they are off by.
    assert 0.015 < right.one_degree.below < 0.08
    assert right.one_degree.above == pytest.approx(0.025, abs=0.01)
    wrong = consistency(bag, load_config((), {**SMALL, "lidar.range_noise": 0.09})).counts
    assert wrong.one_degree.below > 0.06
    assert wrong.one_degree.above < 0.001
    assert wrong.points == pytest.approx(right.points, rel=0.05)


def test_ground_seen_once_cannot_be_judged(tmp_path):
    bag = write_ros2(tmp_path / "bag", scans=1)
    with pytest.raises(EvaluationError, match="already mapped"):
        consistency(bag, load_config((), SMALL))


def test_table_tells_both_tests():
    text = Consistency(Counts(1000, 24, 26, 360, 1), 5).table()
    assert "2.40%" in text
    assert "36.00%" in text
    assert len({len(line) for line in text.splitlines()}) == 1
