# SPDX-License-Identifier: Apache-2.0
"""One wrong pose poisons nothing; many that agree with each other are right."""

import numpy as np
import pytest
from core.builders import configured, look
from core.scenes import flat, make_pose, pose_covariance, scan, scattered

from quadtree_lss.onboard.core.geometry.rotations import exp
from quadtree_lss.onboard.core.mapping.alignment import OVERRULING_SCANS
from quadtree_lss.onboard.core.mapping.mapper import Mapper, ScanReport
from quadtree_lss.onboard.core.sensing.lidar import Pose

NOISE = 0.02
CLAIMED = pose_covariance(0.05, 1e-3)


def hills(x, y):
    return 0.3 * np.sin(0.8 * x) * np.cos(0.7 * y)


class Flight:
    """A lander that hovers over hills; each scan half a second after the one before.

    Some ``scans`` have been flown, with true poses.
    """

    def __init__(
        self,
        seed: int = 1,
        size: float = 16.0,
        ground=hills,
        scans: int = 0,
        paper: str = "none",
    ) -> None:
        self.ground = ground
        domain = {"xmin": 0.0, "ymin": 0.0, "size": size, "min_level": 2, "max_level": 4}
        config = configured(domain=domain, noise=NOISE, mapping={"paper": paper})
        self.size, self.above = size, np.array([0.5 * size, 0.5 * size, 60.0])
        self.mapper = Mapper(config)
        self.rng = np.random.default_rng(seed)
        self.scans = 0
        for _ in range(scans):
            self.fly()

    def fly(
        self,
        off=(0.0, 0.0, 0.0),
        turned=(0.0, 0.0, 0.0),
        extent=None,
        claimed=CLAIMED,
        along=None,
    ) -> ScanReport:
        """One scan from x to x and from y to y, by default of all, its pose off and turned by so
        much."""
        west, east = extent or (0.0, self.size)
        south, north = along or (0.0, self.size)
        self.scans += 1
        true = make_pose(self.above, claimed, self.scans * 500_000_000)
        x = self.rng.uniform(west, east, 6000)
        y = self.rng.uniform(south, north, 6000)
        points = scan(self.ground, x, y, true, NOISE, self.rng)
        rotation = exp(np.array(turned)) @ true.rotation_map_lidar
        pose = Pose(true.stamp_ns, true.position + off, rotation, claimed)
        return self.mapper.update(points, pose)

    def errors(self, datum: float = 0.0) -> np.ndarray:
        """Elevation over the ground, at the leaves with a plane, less the datum."""
        cells = self.mapper.snapshot()
        known = cells.estimated
        return (cells.z - self.ground(cells.x, cells.y))[known] - datum


def rows(mapper: Mapper) -> bytes:
    return mapper.leaves.rows[: mapper.leaves.count].tobytes() + mapper.leaves.observed.tobytes()


@pytest.mark.parametrize(
    "wrong",
    [
        {"off": (0.0, 0.0, 3.0)},
        {"off": (0.0, 0.0, -1000.0)},
        {"off": (0.0, 0.0, 7e6)},
        {"turned": (0.15, 0.0, 0.0)},
    ],
)
def test_a_scan_that_contradicts_the_map_changes_nothing(wrong):
    flight = Flight(size=64.0, scans=5)
    before = rows(flight.mapper)
    report = flight.fly(**wrong)
    assert report.points_used == 0
    assert report.dropped["contradiction"] > 1000
    assert sum(report.dropped.values()) == report.points
    assert rows(flight.mapper) == before
    assert flight.fly().points_used > 5000
    assert np.abs(flight.errors()).max() < 0.2


def test_a_few_wrong_poses_in_a_row_do_not_win_and_neither_do_many_that_disagree():
    flight = Flight(scans=3)
    for _ in range(OVERRULING_SCANS - 1):
        flight.fly(off=(0.0, 0.0, 4.0))
    flight.fly()
    for number in range(3 * OVERRULING_SCANS):
        assert flight.fly(off=(0.0, 0.0, 4.0 * (2 + number % 3))).points_used == 0
    flight.fly()
    assert np.abs(flight.errors()).max() < 0.2


def test_many_that_agree_win_and_what_was_mapped_goes_with_them():
    flight = Flight(scans=5)
    leaves = flight.mapper.leaves.count
    reports = [flight.fly(off=(0.0, 0.0, 4.0), extent=(0.0, 8.0)) for _ in range(OVERRULING_SCANS)]
    assert [report.overruled for report in reports] == [False] * (OVERRULING_SCANS - 1) + [True]
    assert flight.mapper.leaves.count >= leaves
    # The half that was not seen again was lifted, too.
    assert np.abs(flight.errors(4.0)).max() < 0.2


@pytest.mark.parametrize("east", [6.0, 10.0])
def test_a_view_narrower_than_the_leaves_contradicts_the_map_too(east):
    flight = Flight(ground=lambda x, y: 0.0 * x, scans=5)  # leaves of 4 m: one is touched, or two
    before = rows(flight.mapper)
    view = {"extent": (east - 1.5, east), "along": (4.5, 6.0)}
    for _ in range(OVERRULING_SCANS - 1):
        assert flight.fly(off=(0.0, 0.0, 0.6), **view).dropped["contradiction"] == 6000
    assert rows(flight.mapper) == before
    assert flight.fly(off=(0.0, 0.0, 0.6), **view).overruled
    assert np.abs(flight.errors(0.6)).max() < 0.1


def test_a_map_that_cannot_be_lifted_to_them_is_forgotten():
    flight = Flight(size=64.0, scans=5)
    for _ in range(OVERRULING_SCANS):
        report = flight.fly(turned=(0.2, 0.0, 0.0))
    assert report.overruled
    assert report.points_used > 1000
    known = flight.mapper.snapshot()
    # Level ground is now inclined as the poses say.
    assert np.median(known.normal[known.measured, 1]) == pytest.approx(-np.sin(0.2), abs=0.03)


@pytest.mark.parametrize("height", [1000.0, -30.0, 7e6])
def test_planes_of_a_wrong_pose_over_new_ground_go_with_the_next_scan(height):
    """The half that no other scan has seen has nothing to contradict."""
    flight = Flight()
    for _ in range(5):
        flight.fly(extent=(0.0, 8.0))
    assert flight.fly(off=(0.0, 0.0, height), extent=(8.0, 16.0)).points_used > 1000
    assert np.abs(flight.errors()).max() > 20.0
    for _ in range(8):
        flight.fly()
    assert np.abs(flight.errors()).max() < 0.3


def test_points_are_votes_where_a_plane_is_of_another_place_altogether():
    """One cell, which no others judge: the wrong plane goes when as many points are against it."""
    domain = {"size": 4.0, "min_level": 0, "max_level": 0}
    mapper, rng = Mapper(configured(domain=domain)), np.random.default_rng(5)
    heights = []
    for number, (high, count) in enumerate(((50.0, 300), *[(0.0, 100)] * 4)):
        places, pose = scattered(rng, 0, 0, 4, count), make_pose((2.0, 2.0, 500.0), stamp_ns=number)
        look(mapper, flat(high), *places, rng, NOISE, pose)
        heights.append(mapper.snapshot().z[0])
    np.testing.assert_allclose(heights, [50.0, 50.0, 50.0, 0.0, 0.0], atol=0.05)


def test_what_comes_onto_mapped_ground_is_not_known():
    """A block of 3 m by 3 m, of which a tenth of the scan's returns tell."""
    domain = {"xmin": 0.0, "ymin": 0.0, "size": 8.0, "min_level": 5, "max_level": 5}
    mapper, rng = Mapper(configured(domain=domain)), np.random.default_rng(7)

    def block(x, y):
        return 5.0 * ((np.abs(x - 4.0) < 1.5) & (np.abs(y - 4.0) < 1.5))

    def fly(ground, stamp_ns):
        pose = make_pose((4.0, 4.0, 500.0), stamp_ns=stamp_ns)
        look(mapper, ground, *scattered(rng, 0.0, 0.0, 8.0, 20000), rng, NOISE, pose)
        known = mapper.snapshot().known
        return known[11:21, 11:21], np.r_[known[:9].ravel(), known[-9:].ravel()]

    for number in range(10):
        fly(flat(0.0), number)
    for number in range(10, 13):
        under, beside = fly(block, number)
        assert not under.any()
        assert beside.all()
    under, beside = fly(flat(0.0), 13)
    assert under.all()
    # One return alone, which the outlier gate let through, is no evidence.
    pose = make_pose((4.0, 4.0, 500.0), stamp_ns=14)
    look(mapper, flat(5.0), np.full(1, 4.1), np.full(1, 4.1), rng, NOISE, pose)
    assert mapper.snapshot().known.all()


@pytest.mark.parametrize("seed", range(8))
def test_no_claim_moves_the_map_beyond_what_the_others_allow(seed):
    """Exact poses that claim anything a message may claim, among such that know."""
    rng = np.random.default_rng(seed)
    flight = Flight(seed)
    for number in range(60):
        claimed = CLAIMED.copy()
        if rng.random() < 0.4:
            root = rng.standard_normal((6, 6)) * 10.0 ** rng.uniform(-6, 3, 6)[:, None]
            claimed = root @ root.T
            widest = claimed.diagonal()[3:].max()
            scale = np.array([1.0] * 3 + [min(1.0, 0.5 / np.sqrt(widest))] * 3)
            claimed *= np.outer(scale, scale)
        true = make_pose(flight.above, claimed, (number + 1) * 50_000_000)
        look(flight.mapper, hills, *scattered(rng, 0.0, 0.0, 16.0, 3000), rng, NOISE, true)
        assert np.abs(flight.errors()).max(initial=0.0) < 0.25 or number < 3


@pytest.mark.parametrize("position", [0.05, 0.3])
@pytest.mark.parametrize("deviations", [-200.0, -20.0, -8.0, -5.0, 5.0, 8.0, 20.0, 200.0])
def test_a_height_far_beyond_its_claim_moves_the_map_by_less_than_a_tenth(position, deviations):
    flight, claimed, off = Flight(), pose_covariance(position, 1e-3), deviations * position
    for number in range(5):
        flight.fly(off=(0.0, 0.0, off if number == 4 else 0.0), claimed=claimed)
    assert abs(np.median(flight.errors())) < 0.1 * abs(off)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("deviations", [5.0, 8.0, 20.0])
def test_a_tilt_far_beyond_its_claim_tilts_the_map_by_less_than_a_tenth(deviations, axis):
    flight, angle = Flight(ground=flat(), scans=4), deviations * 1e-3
    flight.fly(turned=angle * np.eye(3)[axis])
    cells = flight.mapper.snapshot()
    along = (cells.y, cells.x)[axis]
    slope = np.polyfit(along[cells.measured], cells.z[cells.measured], 1)[0]
    assert abs(slope) < 0.1 * angle


def cliffs(x, y):
    """Ground of 25 degrees with steps of 3 m."""
    return 0.47 * x + 3.0 * (np.mod(x + 0.4 * y, 7.0) > 3.5)


def rubble(x, y):
    """Steep in all directions, metre by metre."""
    return 0.3 * x + 0.6 * np.sin(2.1 * x + 0.5) * np.cos(1.7 * y)


@pytest.mark.parametrize("ground", [cliffs, rubble])
@pytest.mark.parametrize("position", [0.05, 0.3])
def test_steep_ground_is_no_contradiction(ground, position):
    """Poses drawn from what they claim, sideways above all, each anew."""
    claimed = pose_covariance(position, 1e-3)
    refused = 0
    for seed in range(5):
        flight = Flight(seed, ground=ground)
        for _ in range(20):
            off = position * flight.rng.standard_normal(3)
            turned = 1e-3 * flight.rng.standard_normal(3)
            west = flight.rng.uniform(0.0, 8.0)
            report = flight.fly(off, turned, extent=(west, west + 8.0), claimed=claimed)
            refused += report.points_used == 0
    assert refused == 0


@pytest.mark.parametrize("paper", ["none", "covariance"])
def test_poses_that_err_as_they_claim_are_not_refused(paper):
    """However a scan's pose error is thought to be shared out, all of the scan moves by it."""
    flight, claimed = Flight(paper=paper), pose_covariance(0.5, 1e-3)
    errors = 0.5 * np.random.default_rng(8).standard_normal((40, 3))
    reports = [flight.fly(off=tuple(off), claimed=claimed) for off in errors]
    assert all(report.points_used > 0 and not report.overruled for report in reports)
    assert flight.fly(off=(0.0, 0.0, 5.0), claimed=claimed).points_used == 0


def test_rejected_scans_agree_if_they_differ_by_no_more_than_their_poses_claim():
    flight, claimed = Flight(ground=flat(), scans=5), pose_covariance(0.3, 1e-3)
    heights = 9.0 + 0.3 * flight.rng.standard_normal(OVERRULING_SCANS)
    reports = [flight.fly(off=(0.0, 0.0, high), claimed=claimed) for high in heights]
    assert [report.overruled for report in reports] == [False] * (OVERRULING_SCANS - 1) + [True]
