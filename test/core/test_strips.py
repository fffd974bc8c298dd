# SPDX-License-Identifier: Apache-2.0
"""Strips that meet in rough ground (tree crowns), and leaves whose first plane moves later."""

import numpy as np
import pytest

from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose

DOWN = np.diag([1.0, -1.0, -1.0])
WIDTH = 32.0
CROWNS = 12.0  # y from which on trees stand, m
HEIGHT = 400.0
CONFIG = config_from_values(
    {
        "domain.xmin": 0.0,
        "domain.ymin": 0.0,
        "domain.size": WIDTH,
        "domain.min_level": 2,
        "domain.max_level": 6,
        "lidar.range_noise": 0.03,
    }
)


def strip(west: float, east: float, rng: np.random.Generator) -> np.ndarray:
    """Returns (N, 3), 8 per square metre: level ground, and crowns up to 12 m beyond `CROWNS`."""
    count = int(8 * (east - west) * WIDTH)
    points = rng.uniform((west, 0.0, 0.0), (east, WIDTH, 0.0), (count, 3))
    trees = points[:, 1] > CROWNS
    points[trees, 2] = rng.uniform(0.0, 12.0, int(trees.sum()))
    points[:, 2] += 0.03 * rng.standard_normal(count)
    return points


def mapped(strips: list[tuple[float, float]], lift: float = 0.0) -> tuple[Mapper, list[int]]:
    """The mapper after the strips, and the points that entered of each; the last is ``lift`` up."""
    rng, mapper, used = np.random.default_rng(4), Mapper(CONFIG), []
    position = np.array([0.5 * WIDTH, 0.5 * WIDTH, HEIGHT])
    covariance = np.diag([0.05**2] * 3 + [1e-8] * 3)
    for number, (west, east) in enumerate(strips):
        points = strip(west, east, rng)
        points[:, 2] += lift if number == len(strips) - 1 else 0.0
        pose = Pose(10**9 * (number + 1), position, DOWN, covariance)
        used.append(mapper.update((points - position) @ DOWN, pose).points_used)
    return mapper, used


STRIPS = [(4.0 * k, min(4.0 * k + 5.0, WIDTH)) for k in range(8)]


def test_strips_that_overlap_in_tree_crowns_are_mapped_at_their_height() -> None:
    mapper, used = mapped(STRIPS)
    assert min(used) > 0
    cells = mapper.snapshot()
    ground = np.isfinite(cells.z) & cells.measured & (cells.y + 0.5 * cells.size < CROWNS)
    assert np.count_nonzero(ground) >= 16
    assert np.max(np.abs(cells.z[ground])) < 0.1  # two standard deviations of the poses' heights


def test_ground_of_the_first_strip_stays_part_of_the_map() -> None:
    """A coarse leaf is first seen at one edge; its plane moves at the far corner only."""
    cells = mapped(STRIPS)[0].snapshot()
    rows = int(CROWNS / WIDTH * cells.domain.finest_count) - 2
    seen, known = cells.observed[:rows], cells.known[:rows]
    assert np.count_nonzero(known & seen) > 0.97 * np.count_nonzero(seen)


@pytest.mark.parametrize("lift", [3.0, -3.0])
def test_a_strip_at_another_height_is_rejected_on_smooth_ground(lift: float) -> None:
    """Rough ground does not hide a wrong pose where enough smooth ground overlaps."""
    _, used = mapped([*STRIPS, (0.0, WIDTH)], lift)
    assert min(used[:-1]) > 0 and used[-1] == 0
