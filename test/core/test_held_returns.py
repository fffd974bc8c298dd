# SPDX-License-Identifier: Apache-2.0
"""Isolated returns at places that enough scans show enter the map; the others are held back."""

import numpy as np
import pytest

from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.core.tree.held_returns import SHOWN, HeldReturns

from .builders import configured

DOWN = np.diag([1.0, -1.0, -1.0])
HEIGHT, PIXELS, SIDE = 100.0, 64, 16.0
DOMAIN = Domain(0.0, 0.0, SIDE, 2, 6)
SECOND = 10**9


def scan(heights: np.ndarray, number: int, noise: float = 0.02) -> tuple[np.ndarray, Pose]:
    """An organised scan of ``heights`` (PIXELS, PIXELS) [y, x], one pixel to a finest cell."""
    rng = np.random.default_rng(number)
    step = (np.arange(PIXELS) + 0.5) * SIDE / PIXELS - 0.5 * SIDE
    x, y = np.meshgrid(step, step)
    down = HEIGHT - heights - noise * rng.standard_normal(heights.shape)
    points = np.stack([x, -y, down], axis=-1)
    covariance = np.diag([1e-6] * 3 + [1e-10] * 3)
    position = np.array([0.5 * SIDE, 0.5 * SIDE, HEIGHT])
    return points, Pose(SECOND * (number + 10), position, DOWN, covariance)


def bush(number: int) -> np.ndarray:
    """Level ground with a bush that four pixels hit, all more than the gate apart."""
    heights = np.zeros((PIXELS, PIXELS))
    rough = np.array([[0.6, 1.6], [1.6, 0.6]])
    heights[30:32, 40:42] = rough + np.random.default_rng(number).uniform(-0.1, 0.1, (2, 2))
    return heights


def mapper(**domain: object) -> Mapper:
    base = {"size": SIDE, "min_level": 2, "max_level": 6}
    return Mapper(configured(noise=0.02, vehicle={"outlier_gate": 0.4}, domain={**base, **domain}))


def highest(of: Mapper) -> float:
    """Of all returns in the map, m."""
    rows = of.leaves.rows[: of.leaves.count]
    return float(rows["high"].max())


def test_a_bush_enters_once_enough_scans_show_it():
    found = mapper()
    for number in range(SHOWN - 1):
        report = found.update(*scan(bush(number), number))
        assert report.dropped["isolated"] == 4 and report.admitted == 0 and highest(found) < 0.3
    last = found.update(*scan(bush(SHOWN - 1), SHOWN - 1))
    assert last.dropped["isolated"] == 0 and last.admitted == 4
    assert last.points_used == last.points and highest(found) > 1.2
    later = found.update(*scan(bush(SHOWN), SHOWN))
    assert later.dropped["isolated"] == 0 and later.admitted == 0


@pytest.mark.parametrize(("east", "north"), [(1, 0), (0, 1), (-1, 1)])
def test_a_bush_enters_also_when_the_domain_moved_since(east, north):
    found, step = mapper(follow="vehicle", min_level=3), PIXELS // 4
    found.update(*scan(bush(0), 0))
    for number in range(1, SHOWN):
        shifted = np.roll(bush(number), (-north * step, -east * step), (0, 1))
        points, pose = scan(shifted, number)
        pose.position[:2] += 0.25 * SIDE * np.array([east, north])
        assert found.update(points, pose).admitted == 4 * (number == SHOWN - 1)
    assert (found.domain.xmin, found.domain.ymin) == (0.25 * SIDE * east, 0.25 * SIDE * north)


def test_random_strays_stay_out():
    found, strays, entered = mapper(), 0, 0
    for number in range(20):
        rng = np.random.default_rng(100 + number)
        heights = np.zeros((PIXELS, PIXELS))
        stray = rng.random(heights.shape) < 0.01
        heights[stray] = rng.uniform(1.0, 10.0, stray.sum())
        report = found.update(*scan(heights, number))
        strays += int(stray.sum())
        entered += report.admitted
        assert report.points_used + sum(report.dropped.values()) == report.points
    assert strays > 300 and entered <= 0.002 * strays


def test_a_restored_mapper_still_holds_returns_back():
    found, restored = mapper(), mapper()
    for number in range(SHOWN - 1):
        found.update(*scan(bush(number), number))
    restored.import_state(found.export_state())
    for other in (found, restored):
        assert other.update(*scan(bush(SHOWN), SHOWN)).admitted == 4


@pytest.mark.parametrize("how", ["reset", "time jumps back"])
def test_nothing_is_held_back_after(how):
    found = mapper()
    for number in range(5, 4 + SHOWN):
        found.update(*scan(bush(number), number))
    if how == "reset":
        found.reset()
    report = found.update(*scan(bush(1), 0))
    assert report.admitted == 0 and report.dropped["isolated"] == 4


def test_a_rejected_scan_changes_nothing():
    found = mapper()
    for number in range(SHOWN - 1):
        found.update(*scan(bush(number), number))
    for number in (SHOWN, SHOWN + 1):
        rejected = found.update(*scan(bush(number) + 5.0, number))
        assert rejected.dropped["contradiction"] > 0 and rejected.admitted == 0
    assert found.update(*scan(bush(0), SHOWN + 2)).admitted == 4


POINT = np.array([[5.1, 6.2, 1.5]])


def held(*points: np.ndarray) -> HeldReturns:
    """After a scan of each of these isolated returns (1, 3)."""
    found = HeldReturns(DOMAIN)
    for point in points:
        found.keep(found.compare(point, DOMAIN, 0.4))
    return found


@pytest.mark.parametrize(
    ("offset", "same_place"),
    [
        ((0.0, 0.0, 0.39), True),
        ((0.0, 0.0, 0.41), False),
        ((0.25, 0.25, 0.0), True),
        ((0.5, 0.0, 0.0), False),
        ((20.0, 0.0, 0.0), False),
    ],
)
def test_a_place_is_within_the_gate_in_the_same_or_a_neighbouring_cell(offset, same_place):
    found = held(*[POINT] * (SHOWN - 1))
    compared = found.compare(POINT + offset, DOMAIN, 0.4)
    assert compared.confirmed.tolist() == [same_place]
    assert len(compared.admitted) == same_place
    place = found.places(compared.admitted, DOMAIN)
    assert (np.abs(place - POINT) <= (0.125, 0.125, 1e-6)).all()


@pytest.mark.parametrize(("scans", "shown"), [(1, 2), (SHOWN - 1, SHOWN), (SHOWN, SHOWN)])
def test_only_confirmed_places_outlast_many_scans(scans, shown):
    found = held(*[POINT] * scans)
    assert found.compare(POINT, DOMAIN, 0.4).shown.tolist() == [shown]
    for _ in range(30):
        found.scans += 1
    compared = found.compare(POINT, DOMAIN, 0.4)
    assert (
        compared.shown.tolist() == [SHOWN if scans == SHOWN else 1] and len(compared.admitted) == 0
    )


def test_held_back_returns_follow_the_domain():
    found, moved = held(*[POINT] * (SHOWN - 1)), DOMAIN.moved(1, -1)
    found.follow(16, -16)
    assert found.compare(POINT, moved, 0.4).confirmed.all()
    found.follow(64, 0)
    assert not found.shown.any()


def test_held_back_returns_are_lifted_with_the_map():
    found = held(*[POINT] * (SHOWN - 1))
    found.lifted += 3.0
    lifted = POINT + (0.0, 0.0, 3.0)
    compared = found.compare(lifted, DOMAIN, 0.4)
    assert compared.confirmed.all() and not found.compare(POINT, DOMAIN, 0.4).confirmed.any()
    assert found.places(compared.admitted, DOMAIN)[0, 2] == pytest.approx(lifted[0, 2])
