# SPDX-License-Identifier: Apache-2.0
"""A square that follows: what stays inside is as if it had always lain there, to the bit."""

import dataclasses
import io

import numpy as np
import pytest
from core.builders import configured, look
from core.scenes import flat, make_pose, pose_covariance, scattered
from hypothesis import given
from hypothesis import strategies as st

from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.core.geometry import morton
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.landing.target import Reason
from quadtree_lss.onboard.core.mapping.alignment import OVERRULING_SCANS
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.tree.checkpoint import CheckpointError, from_file, to_bytes
from quadtree_lss.onboard.core.tree.domain import FOLLOW_SHARE, Domain
from quadtree_lss.onboard.core.tree.leaves import LEAF
from quadtree_lss.onboard.messages.maps import round_trip

SQUARE = Domain(0.0, 0.0, 16.0, 4, 7)
FOLLOWING = configured((4, 7), domain={"follow": "vehicle"}, lss={"grid_spacing": 0.25})
FIXED = configured((7, 10), domain={"xmin": -64.0, "ymin": -64.0, "size": 128.0})


def ground(x, y):
    """Waves, with a block of 0.4 m every 4 m."""
    block = (np.hypot((x + 1.0) % 4.0 - 2.0, (y + 1.0) % 4.0 - 2.0) < 0.4) * 0.4
    return 0.2 * np.sin(0.5 * x) * np.cos(0.4 * y) + block


def fly(mappers, steps, *, wide=5.0, start=0, along=(0.5, 0.2)):
    """Scans of what lies within ``wide`` metres under a vehicle that errs in height."""
    for number in range(start, start + steps):
        rng = np.random.default_rng(1000 + number)
        x, y = 8.0 + along[0] * number, 8.0 + along[1] * number
        told = make_pose((x, y, 30.0), pose_covariance(0.03, 1e-3), stamp_ns=10**8 * (number + 1))
        places = scattered(rng, x - wide, y - wide, 2.0 * wide, 3000)
        high, state = 0.02 * rng.standard_normal(), rng.bit_generator.state
        for mapper in mappers:
            rng.bit_generator.state = state
            look(mapper, ground, *places, rng, 0.02, told, high)
    return mappers


def by_place(mapper, inside):
    """Leaves by level and centre, those that lie in a domain, and the observed cells under it."""
    leaves = mapper.leaves.rows[: mapper.leaves.count]
    half = 0.5 * mapper.domain.cell_size(leaves.level)
    within = (leaves.x - half >= inside.xmin) & (leaves.x + half <= inside.xmin + inside.size)
    within &= (leaves.y - half >= inside.ymin) & (leaves.y + half <= inside.ymin + inside.size)
    rows = leaves[within]
    return rows[np.lexsort((rows.x, rows.y))]


def assert_same_bits(one, other):
    """But for what tells where in its own tree a leaf is."""
    assert len(one) == len(other)
    for name in set(LEAF.names) - {"level", "ix", "iy"}:
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)


@given(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.integers(3, 9))
def test_moved_once_it_is_near_the_middle_and_stays(x, y, level):
    square = dataclasses.replace(SQUARE, min_level=level, max_level=9)
    moved = square.moved(*square.steps_to(x, y))
    for corner, place in ((moved.xmin, x), (moved.ymin, y)):
        assert abs(place - corner - 8.0) <= FOLLOW_SHARE * 16.0
    assert moved.steps_to(x, y) == (0, 0)
    # A vehicle that turns back at once does not take it back.
    far = 0.9 * (FOLLOW_SHARE - 1.0 / 16.0) * 16.0
    back = [c + 8.0 + far if abs(p - c - 8.0) < 1.0 else p
            for c, p in ((moved.xmin, x), (moved.ymin, y))]  # fmt: skip
    assert moved.steps_to(*back) == (0, 0)
    cells = square.cells_to(moved)
    assert cells is not None and cells[0] % 2 ** (9 - level) == cells[1] % 2 ** (9 - level) == 0


def test_ground_that_stays_inside_has_the_bits_of_a_fixed_map():
    following, fixed = fly((Mapper(FOLLOWING), Mapper(FIXED)), 40)
    assert following.domain.xmin >= 16.0, "the vehicle left the first square altogether"
    one = by_place(following, following.domain)
    assert np.count_nonzero(one.state == 3) > 300 and len(set(one.level)) > 1
    assert_same_bits(one, by_place(fixed, following.domain))
    east, north = round(8 * (following.domain.xmin + 64)), round(8 * (following.domain.ymin + 64))
    own, whole = following.snapshot(), fixed.snapshot()
    for name in ("observed", "known"):
        part = getattr(whole, name)[north : north + 128, east : east + 128]
        np.testing.assert_array_equal(getattr(own, name), part)
    np.testing.assert_array_equal(piles(following), piles(fixed)[north:, east:][:128, :128])


def piles(mapper: Mapper) -> np.ndarray:
    """(n, n, 2) what is kept of each finest cell, by row and column."""
    places = morton.SPREAD[: mapper.domain.finest_count]
    return mapper.leaves.piled[places | places[:, None] << 1]


def test_a_wrong_pose_does_not_drop_the_map():
    (mapper,) = fly((Mapper(FOLLOWING),), 6)
    before, domain = mapper.snapshot(), mapper.domain
    away = make_pose((9e3, 8.0, 30.0), pose_covariance(0.03, 1e-3), stamp_ns=7 * 10**8)
    for k in range(2 * OVERRULING_SCANS - 1):
        assert mapper.domain == domain
        if k == OVERRULING_SCANS - 1:  # those before a state is taken up do not count
            mapper.import_state(mapper.export_state())
        places = scattered(np.random.default_rng(k), 8995.0, 3.0, 10.0, 500)
        look(mapper, flat(), *places, pose=away)
        if k == 0:
            assert np.array_equal(before.z, mapper.snapshot().z, equal_nan=True)
    assert mapper.domain.steps_to(9e3, 8.0) == (0, 0), "nor does it stay behind for ever"


def test_a_checkpoint_carries_the_origin():
    (mapper,) = fly((Mapper(FOLLOWING),), 20)
    content = to_bytes(mapper.export_state())
    restored = Mapper(FOLLOWING)
    restored.import_state(from_file(io.BytesIO(content)))
    assert restored.domain == mapper.domain
    assert to_bytes(restored.export_state()) == content
    one, other = fly((mapper, restored), 20, start=20)
    assert_same_bits(by_place(one, one.domain), by_place(other, one.domain))
    for values in ({"domain.follow": "none"}, {"domain.xmin": 0.5}, {"domain.max_level": 6}):
        stranger = Mapper(config_from_values(values, FOLLOWING))
        with pytest.raises(CheckpointError, match="another domain|version"):
            stranger.import_state(from_file(io.BytesIO(content)))
        assert stranger.domain == Domain.of(stranger.config.domain)


@pytest.mark.parametrize("assessment", ["touchdown", "probability"])
def test_a_target_is_never_moved_by_a_move(assessment):
    values = {"lss.assessment": assessment, "vehicle.diameter": 2.0,
              "lss.dispersion": 0.1, "lss.max_risk": 0.1}  # fmt: skip
    config = config_from_values(values, FOLLOWING)
    mapper, selector = Mapper(config), LandingSiteSelector(config)
    fly((mapper,), 12, along=(0.0, 0.0))
    chosen = [selector.assess(round_trip(mapper.snapshot())) for _ in range(2)][-1]
    assert chosen.selected.id and chosen.selected.reason is Reason.FIRST
    x, y, _ = chosen.selected.position
    # The vehicle goes round it, looking at nothing new.
    kept, domains = [], set()
    for east, north in ((2.5, 0.0), (0.0, 2.5), (-2.5, -2.5), (0.0, 0.0)):
        mapper.leaves.follow(*mapper.domain.steps_to(x + east, y + north))
        domains.add(mapper.domain)
        kept.append(selector.assess(round_trip(mapper.snapshot())))
    assert len(domains) > 2
    for found in kept:
        assert found.selected.reason is Reason.HOLDS and found.selected.id == chosen.selected.id
        np.testing.assert_array_equal(found.selected.position[:2], (x, y))
        new = LandingSiteSelector(config).assess(round_trip(mapper.snapshot()))
    np.testing.assert_array_equal(kept[-1].hazard, new.hazard)


def test_what_a_pass_keeps_of_the_map_before_is_what_a_new_one_finds():
    """From scan to scan, over moves, and of another map."""
    base = configured(domain={"size": 32.0, "min_level": 5, "max_level": 7, "follow": "vehicle"})
    config = config_from_values({"lss.grid_spacing": 0.25, "vehicle.diameter": 3.0}, base)
    mapper, follower = Mapper(config), LandingSiteSelector(config)
    moves = ((0, 0), (0, 0), (2, 0), (2, -4), (0, 0), (-6, 2), (1, 0), (40, 0), (0, 0))
    for number, (east, north) in enumerate(moves):
        if number == len(moves) - 1:
            mapper.reset()  # and begins anew on other ground
        mapper.leaves.follow(east, north)
        d, rng, high = mapper.domain, np.random.default_rng(number), 100.0 * (number > 7)
        pose = make_pose((d.xmin + 16.0, d.ymin + 16.0, 300.0), stamp_ns=number + 1)
        places = scattered(rng, d.xmin + 8.0 * (number % 2), d.ymin + 8.0, 24.0, 30000)
        look(mapper, lambda x, y, z=high: ground(x, y) + z, *places, rng, 0.05, pose)
        cells = round_trip(mapper.snapshot())
        followed, anew = follower.assess(cells), LandingSiteSelector(config).assess(cells)
        for name in ("hazard", "safe", "score"):
            np.testing.assert_array_equal(getattr(followed, name), getattr(anew, name))
        np.testing.assert_array_equal(followed.sites.position, anew.sites.position)
        assert ((anew.hazard & 8) > 0).any()


def test_ground_found_safe_before_a_move_was_found_safe():
    """The first target is one that the assessment before found safe, too: on the same ground."""
    config = config_from_values({"vehicle.diameter": 2.0}, FOLLOWING)
    mapper, selector = Mapper(config), LandingSiteSelector(config)
    fly((mapper,), 12, along=(0.0, 0.0))
    assert selector.assess(round_trip(mapper.snapshot())).selected.reason is Reason.UNCONFIRMED
    mapper.leaves.follow(3, -2)
    assert selector.assess(round_trip(mapper.snapshot())).selected.reason is Reason.FIRST
