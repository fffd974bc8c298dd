# SPDX-License-Identifier: Apache-2.0
"""The target: it stays while landing there is permitted; a number lasts as long as its place."""

import dataclasses
from unittest import mock

import numpy as np
import pytest
from core.builders import mapped
from core.kernels import tangent_basis
from core.scenes import flat
from core.test_sites import small
from hypothesis import given, settings
from hypothesis import strategies as st

from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing import sites
from quadtree_lss.onboard.core.landing.lattice import ground_planes
from quadtree_lss.onboard.core.landing.raster import rasterise
from quadtree_lss.onboard.core.landing.sites import LandingSiteSelector, ground_covariance
from quadtree_lss.onboard.core.landing.target import (
    NEARER,
    SWITCH,
    Candidates,
    Choice,
    Descent,
    Reason,
    State,
    TargetKeeper,
)

NAN = np.nan
LSS = LssConfig()
AXIS = np.arange(4.0)


def ground(merit, safe=None, axis=AXIS):
    """A grid of one row."""
    merit = np.array([merit], dtype=np.float64)
    safe = np.isfinite(merit) if safe is None else np.array([safe])
    return Candidates(axis, np.zeros(1), safe, -merit)


def chosen(keeper: TargetKeeper, seen: Candidates, **others: object) -> Choice:
    why = {"why_not": lambda *_: Reason.HAZARD, "why_none": Reason.NO_SITE}
    return keeper.choose(seen, LSS, reach=0.9, **why, **others)


def choose(keeper: TargetKeeper, *seen: Candidates, **others: object) -> Choice:
    """The last choice over some assessments, by a margin of 0.5."""
    for each in seen:
        with mock.patch.dict(SWITCH, {LSS.ranking: 0.5}):
            choice = chosen(keeper, each, **others)
    return choice


def there(column: int, number: int, reason: Reason, state: State = State.HOLDS) -> Choice:
    """A target in the row."""
    return Choice((0, column), number, reason, state)


def test_ground_seen_for_the_first_time_is_no_target_yet():
    keeper = TargetKeeper()
    first = choose(keeper, ground([1, 2, 3, NAN]))
    assert first == Choice(None, 0, Reason.UNCONFIRMED, best=(0, 2))
    first = choose(keeper, ground([1, 2, NAN, 9]))
    assert first == there(1, 1, Reason.FIRST), "the best of what was safe before"


def test_newly_seen_ground_does_not_take_it_over_at_once():
    keeper, seen = TargetKeeper(), ground([1, 2, NAN, NAN])
    choose(keeper, seen, seen)
    assert choose(keeper, ground([1, 2, 9, NAN])).reason is Reason.HOLDS
    assert choose(keeper, ground([1, 2, 9, NAN])) == there(2, 2, Reason.BETTER)


def test_a_lost_one_is_withdrawn_before_another_comes():
    keeper, seen = TargetKeeper(), ground([1, 2, 1, 1])
    choose(keeper, seen, seen)
    assert choose(keeper, ground([1, NAN, 1, 3])) == Choice(None, 0, Reason.HAZARD, best=(0, 3))
    assert choose(keeper, ground([1, NAN, 1, 3])) == there(3, 2, Reason.FIRST)
    assert choose(keeper, ground([NAN] * 4)).reason is Reason.HAZARD
    assert choose(keeper, ground([NAN] * 4)).reason is Reason.NO_SITE
    assert choose(keeper, seen, seen).id == 3, "a number is never given twice"


def test_a_map_without_its_grid_point_loses_it():
    keeper, seen = TargetKeeper(), ground([1, 2, 1, 1])
    choose(keeper, seen, seen)
    assert choose(keeper, ground([1, 1, 1, 1], axis=AXIS + 0.5)).reason is Reason.OUTSIDE_MAP


def test_a_released_one_gives_way_to_the_best():
    keeper, seen = TargetKeeper(), ground([1, 2, 1, 2.2])
    choose(keeper, ground([1, 2, 1, 1]), ground([1, 2, 1, 1]), seen)
    keeper.release()
    assert choose(keeper, seen) == there(3, 2, Reason.RELEASED)
    assert choose(keeper, seen).reason is Reason.HOLDS


def test_a_place_excluded_by_wish_keeps_its_number():
    keeper, seen = TargetKeeper(), ground([1, 2, 1, 1])
    before = choose(keeper, seen, seen)
    kept_out = ground([1, NAN, 1, 1], safe=[True] * 4)
    choose(keeper, kept_out, kept_out)
    keeper.release()
    assert choose(keeper, seen) == there(before.place[1], before.id, Reason.RELEASED)


def unsafe(risks, **others):
    """Grid points in a row of which the cost is the probability that a touchdown fails."""
    found = ground([-risk for risk in risks], **others)
    return dataclasses.replace(found, unsafe=found.cost)


def test_a_gain_less_than_it_is_uncertain_by_moves_nothing():
    for risk, moves in ((0.06, False), (0.02, True)):
        keeper, seen = TargetKeeper(), unsafe([0.5, 0.08, 0.5, 0.5])
        choose(keeper, seen, seen)
        better = unsafe([0.5, 0.08, 0.5, risk])
        for _ in range(2):
            choice = chosen(keeper, better)
        # 0.02 of gain are uncertain by 0.05, 0.06 by 0.041.
        assert (choice.place == (0, 3)) is moves


def test_a_divert_costs_more_the_lower_it_begins():
    for height, moves in ((200.0, True), (62.0, True), (58.0, False), (41.0, False), (2.0, False)):
        keeper, wide = TargetKeeper(), AXIS * 10.0
        seen = ground([1, 1, 1, 0.5], axis=wide)
        choose(keeper, seen, seen)
        better = ground([1, 1, 1, 2.0], axis=wide)
        # 30 m are half of the reach at 59 m of height, where the margin is twice 0.5, and the gain
        # is 1; at 41 m they are beyond it.
        descent = Descent(height, 3.8)
        choice = choose(keeper, better, better, descent=descent)
        assert (choice.place == (0, 3)) is moves, descent.reach


def test_reach_is_that_of_speeding_up_and_slowing_down_aside():
    """Checked against the path: half the time at 1 m/s^2, half at -1 m/s^2."""
    time, steps = np.linspace(0.0, 8.0, 8001, retstep=True)
    speed = np.cumsum(np.where(time < 4.0, 1.0, -1.0)) * steps
    assert Descent(80.0, 10.0).reach == pytest.approx(np.sum(speed) * steps, rel=2e-3)
    assert Descent(10.0, 0.0).reach == 10.0, "not more steeply than 45 degrees"
    assert Descent(-1.0, 1.0).reach == 0.0


def test_below_the_height_of_commitment_only_a_hazard_takes_it_away():
    keeper, seen = TargetKeeper(), ground([1, 2, 1, 1])
    choose(keeper, seen, seen)
    low = Descent(LSS.commit_height - 1.0, 2.0)
    better = ground([1, 2, 3, 1])
    assert choose(keeper, better, better, descent=low) == there(1, 1, Reason.HOLDS, State.COMMITTED)
    assert choose(keeper, ground([1, NAN, 3, 1]), descent=low).reason is Reason.HAZARD, "no risks"
    assert choose(keeper, better, descent=low) == there(2, 2, Reason.FIRST, State.COMMITTED)


def test_a_risk_that_would_not_be_chosen_is_no_hazard_before_it_is_great():
    """Above three times what may be chosen it is, and above a tenth when it is committed."""
    most = 3.0 * LSS.max_risk
    low = Descent(LSS.commit_height - 1.0, 2.0)
    for risk, descent, reason in (
        (0.05, None, Reason.HAZARD),
        (1.01 * most, None, Reason.HAZARD),
        (0.99 * most, None, Reason.HOLDS),
        (0.05, low, Reason.HOLDS),
        (0.2, low, Reason.HAZARD),
    ):
        keeper, seen = TargetKeeper(), unsafe([0.3, 0.01, 0.3, 0.3])
        choose(keeper, seen, seen)
        risky = dataclasses.replace(seen, safe=seen.safe & (AXIS != 1.0))
        risky = dataclasses.replace(risky, cost=np.where(risky.safe, seen.cost, NAN))
        risky.unsafe[0, 1] = risk
        assert choose(keeper, risky, descent=descent).reason is reason
        if risk == 0.99 * most:
            free = np.array([[-1.0, NAN, 0.3, 0.3]]), np.array([[0.0, risk, 0.3, 0.3]])
            free = dataclasses.replace(risky, cost=free[0], unsafe=free[1])
            assert choose(keeper, free).reason is Reason.BETTER, "it gives way all the same"


def test_it_waits_until_it_is_settled_or_asked():
    keeper, seen = TargetKeeper(), ground([1, 2, 1, 1])
    waits = Choice(None, 0, Reason.SETTLING, State.SETTLING, (0, 1))
    assert choose(keeper, seen, seen, settled=False) == waits
    assert choose(keeper, seen) == there(1, 1, Reason.FIRST)
    assert choose(keeper, seen, settled=False).reason is Reason.HOLDS, "once is enough"
    low = Descent(LSS.commit_height, 2.0)
    assert choose(TargetKeeper(), seen, seen, settled=False, descent=low).id == 1


def test_an_unlikely_aim_is_no_target():
    keeper = TargetKeeper()
    few = unsafe([0.3, 0.2, 0.3, 0.3])
    assert choose(keeper, few, few) == Choice(None, 0, Reason.UNLIKELY, best=(0, 1))
    some = unsafe([0.3, 0.2, 0.3, 0.05])
    assert choose(keeper, some) == there(3, 1, Reason.FIRST)
    low = Descent(5.0, 2.0)
    assert choose(keeper, few, descent=low).state is State.COMMITTED, "too low for another"
    assert choose(keeper, few).reason is Reason.UNLIKELY


@settings(max_examples=200)
@given(st.lists(st.lists(st.sampled_from([NAN, 0.0, 0.3, 0.6, 0.9, 2.0]), min_size=4, max_size=4)))
def test_no_change_without_cause(merits):
    """Held while permitted, changed for the margin, withdrawn when lost, on any ground."""
    keeper, last = TargetKeeper(), Choice(None, 0, Reason.UNCONFIRMED)
    for merit in merits:
        choice = choose(keeper, ground(merit))
        assert (choice.place is None) == (choice.reason >= 16) == (choice.id == 0)
        if choice.place is not None:
            assert np.isfinite(merit[choice.place[1]])
        if last.place is not None:
            held = merit[last.place[1]]
            if np.isnan(held):
                assert choice.place is None
            elif choice.place != last.place:
                assert choice.place is not None and merit[choice.place[1]] - held > 0.5
            else:
                assert choice.id == last.id
        last = choice


# ---- of the selector


def block(x, y):
    """One, a metre high, in the middle."""
    return 1.0 * ((np.abs(x - 8.0) < 1.0) & (np.abs(y - 8.0) < 1.0))


@pytest.fixture(scope="module")
def level_ground():
    return mapped(small(), flat(3.0), density=60.0).snapshot()


@pytest.fixture(scope="module")
def with_block():
    return mapped(small(), block, density=100.0).snapshot()


def around(place, half):
    x, y = place[:2]
    return [(x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half)]


def target_of(selector, cells, **where):
    """The target once the ground is confirmed."""
    first = selector.assess(cells, **where)
    assert first.selected.reason is Reason.UNCONFIRMED and first.pending
    second = selector.assess(cells, **where)
    assert second.selected.reason is Reason.FIRST and not second.pending
    return second


def test_the_target_is_the_first_site_and_every_answer_has_a_number(level_ground):
    selector = LandingSiteSelector(small())
    found = target_of(selector, level_ground)
    np.testing.assert_array_equal(found.selected.position, found.sites.position[0])
    assert found.selected.id == found.sites.id[0] > 0
    assert len(set(found.sites.id.tolist())) == len(found.sites.id)
    again = selector.assess(level_ground)
    assert again.selected.reason is Reason.HOLDS
    assert (found.number, again.number) == (2, 3) and found.stamp_ns == again.stamp_ns
    np.testing.assert_array_equal(again.sites.id, found.sites.id)


def test_a_preference_for_another_place_does_not_move_the_target_by_a_little(
    monkeypatch, level_ground
):
    monkeypatch.setitem(NEARER, "score", 0.1)
    selector = LandingSiteSelector(small())
    before = target_of(selector, level_ground, target=(5.0, 5.0)).selected
    after = selector.assess(level_ground, target=(5.0, 5.0)).selected
    assert (after.id, after.reason) == (before.id, Reason.HOLDS)
    # Asked for another place, it goes there.
    moved = selector.assess(level_ground, target=(11.0, 11.0)).selected
    assert moved.reason is Reason.RELEASED and np.hypot(*(moved.position[:2] - 11.0)) < 1.0


@pytest.mark.parametrize(
    ("where", "reason", "pending"),
    [
        ({"keep_out": "around"}, Reason.KEEP_OUT, True),
        ({"withheld": "the map is too old"}, Reason.WITHHELD, False),
        ({"keep_out": [(0.0, 0.0)]}, Reason.WITHHELD, False),
        ({"keep_outs": "around"}, Reason.KEEP_OUT, True),
    ],
)
def test_a_withdrawn_target_says_why(level_ground, where, reason, pending):
    selector = LandingSiteSelector(small())
    place = target_of(selector, level_ground).selected.position
    if where.get("keep_out") == "around":
        where = {"keep_out": around(place, 1.0)}
    if where.get("keep_outs") == "around":
        where = {"keep_out": around((2.0, 2.0), 1.0), "keep_outs": [around(place, 1.0)]}
    found = selector.assess(level_ground, **where)
    assert (found.selected.id, found.selected.reason) == (0, reason)
    assert found.pending is pending
    assert np.isnan(found.selected.position).all() and np.isnan(found.selected.covariance).all()
    if pending:
        again = selector.assess(level_ground, **where).selected
        assert again.reason is Reason.FIRST and np.hypot(*(again.position - place)[:2]) > 1.0


def test_a_new_area_asks_for_a_target_in_it(level_ground):
    selector = LandingSiteSelector(small())
    target_of(selector, level_ground)
    area = around((12.0, 12.0), 3.0)
    found = selector.assess(level_ground, area=area).selected
    assert found.reason is Reason.RELEASED and (np.abs(found.position[:2] - 12.0) < 2.1).all()
    nowhere = selector.assess(level_ground, area=around((12.0, 12.0), 0.5))
    assert nowhere.selected.reason is Reason.NO_SITE and not nowhere.pending


def test_guidance_that_tells_what_it_can_reach_keeps_its_target(monkeypatch, level_ground):
    """Area and aim come anew with every second of a flight."""
    monkeypatch.setitem(NEARER, "score", 0.1)
    selector = LandingSiteSelector(small())
    held = target_of(selector, level_ground, area=around((8.0, 8.0), 8.0)).selected
    for half in (7.0, 6.0):
        area, aim = around(held.position, half), held.position[:2] + 0.3
        found = selector.assess(level_ground, area=area, target=aim).selected
        assert (found.id, found.reason) == (held.id, Reason.HOLDS)
    # Another area that does not hold its zone takes it away at once.
    other = around(held.position + 4.0, 3.0)
    assert selector.assess(level_ground, area=other).selected.reason is Reason.RELEASED


def test_ground_that_turns_out_a_hazard_withdraws_the_target(level_ground, with_block):
    selector = LandingSiteSelector(small())
    held = target_of(selector, level_ground, target=(8.0, 8.0)).selected
    found = selector.assess(with_block, target=(8.0, 8.0))
    assert found.selected.reason is Reason.HAZARD
    assert held.id not in found.sites.id
    empty = dataclasses.replace(with_block, observed=np.zeros_like(with_block.observed))
    assert selector.assess(empty).selected.reason is Reason.NOTHING_MAPPED


def test_unseen_ground_withdraws_the_target(level_ground):
    selector = LandingSiteSelector(small())
    held = target_of(selector, level_ground, target=(5.0, 5.0)).selected.position
    observed = level_ground.observed.copy()
    observed[int(held[1] / 0.5) - 3 :, :] = False
    found = selector.assess(dataclasses.replace(level_ground, observed=observed), target=(5.0, 5.0))
    assert found.selected.reason is Reason.UNSEEN


def test_it_waits_for_a_share_of_the_area_or_some_time(level_ground):
    observed = level_ground.observed.copy()
    observed[:, : observed.shape[1] // 2] = False
    cells = dataclasses.replace(level_ground, observed=observed)
    some = LandingSiteSelector(small(settle_time=3.0))
    for waited, state in ((0.0, State.SETTLING), (2.9, State.SETTLING), (3.0, State.HOLDS)):
        found = some.assess(cells, waited=waited)
        assert found.selected.state is state and not found.pending
        assert found.seen == pytest.approx(0.5, abs=0.03)
    east = LandingSiteSelector(small(settle_time=3.0))
    area = [(9.0, 1.0), (15.0, 1.0), (15.0, 15.0), (9.0, 15.0)]
    assert east.assess(cells, waited=0.0, area=area).pending
    found = east.assess(cells, waited=0.0, area=area)
    assert found.seen == 1.0 and found.selected.id == 1
    # Guidance that says anew what it can still reach asks for no other: there is none yet.
    reach = LandingSiteSelector(small(settle_time=3.0))
    for half in (7.9, 7.8, 7.7):
        found = reach.assess(cells, waited=0.0, area=around((8.0, 8.0), half))
        assert found.selected.state is State.SETTLING


def test_no_site_lies_above_the_vehicle(level_ground):
    """The ground is at 3 m. Poses in NED put the vehicle as far below it as it is above."""
    selector = LandingSiteSelector(small())
    target_of(selector, level_ground)
    assert selector.assess(level_ground, vehicle=(1.0, 0.0)).selected.id, "as navigation errs"
    found = selector.assess(level_ground, vehicle=(-12.0, 0.0))
    assert not len(found.sites) and found.selected.reason.key == "withheld"
    assert "above the vehicle: poses in NED" in found.explanation
    lower = dataclasses.replace(level_ground, offset_z=16.0)
    assert not len(selector.assess(lower, vehicle=(6.0, 0.0)).sites), "by navigation's height"
    assert len(selector.assess(lower, vehicle=(18.0, 0.0)).sites)
    # Far below the map's zero, where nothing is known of the south.
    deep = lifted(level_ground, -1500.0)
    deep.known[:8] = deep.observed[:8] = False
    found = selector.assess(deep, vehicle=(-1480.0, 0.0), area=around((2.0, 2.0), 1.0))
    assert not len(found.sites) and "above the vehicle" not in found.explanation


def test_the_vehicle_is_committed_by_its_height_over_the_target(level_ground):
    """The ground is at 3 m."""
    selector = LandingSiteSelector(small())
    target_of(selector, level_ground)
    # Then navigation has risen by 16 m against the map, and the vehicle with it.
    risen = dataclasses.replace(level_ground, offset_z=16.0)
    flown = [(level_ground, z) for z in (23.1, 22.9, 40.0)] + [(risen, z) for z in (39.1, 38.9)]
    low = [selector.assess(on, vehicle=(z, 2.0)).selected.state for on, z in flown]
    assert low == [State.HOLDS, State.COMMITTED, State.HOLDS, State.HOLDS, State.COMMITTED]


def lifted(cells, z):
    """The same map, so much higher."""
    heights = {name: getattr(cells, name) + z for name in ("z", "low", "high")}
    marks = {name: getattr(cells, name).copy() for name in ("known", "observed")}
    return dataclasses.replace(cells, **heights, **marks)


def by_risk(**lss):
    return small(assessment="probability", **lss)


def test_land_now_takes_the_best_within_reach_at_once(monkeypatch, with_block):
    """Before anything is settled, and low: only what lies near enough, until it is released."""
    monkeypatch.setattr(sites, "SETTLE_SHARE", 1.1)
    monkeypatch.setitem(NEARER, "probability", 0.0)
    selector = LandingSiteSelector(by_risk(dispersion=0.3))
    low = (3.0, 0.5, 4.0, 4.0)
    assert not selector.assess(with_block, waited=0.0, vehicle=low).selected.id
    selector.land_now()
    for _ in range(2):
        found = selector.assess(with_block, waited=0.0, vehicle=low)
        assert found.selected.state is State.NOW and found.selected.reason in (4, Reason.HOLDS)
    x, y, _ = found.selected.position
    assert np.hypot(x - 4.0, y - 4.0) <= 3.0 + 1e-9
    assert found.now[3] >= found.selected.probability > 0.99
    away = np.hypot(found.x - 4.0, found.y[:, None] - 4.0)
    within = np.where((away <= 3.0) & np.isfinite(found.score), found.probability, 0.0)
    assert found.now[3] == within.max()
    selector.release()
    assert selector.assess(with_block, vehicle=low).selected.reason is Reason.RELEASED


def test_land_now_goes_where_the_vehicle_comes_to_rest(level_ground):
    """At 4 m/s it needs 8 m, and 40 m up all of the map is near enough."""
    selector = LandingSiteSelector(by_risk())
    for speed, x in ((0.0, 2.0), (4.0, 10.0)):
        found = selector.assess(level_ground, vehicle=(5.5, 0.5, 2.0, 8.0, speed, 0.0))
        assert np.hypot(found.now[0] - x, found.now[1] - 8.0) <= 2.5 + 1e-9
    assert np.isnan(selector.assess(level_ground, vehicle=(5.5, 0.5, -90.0, 8.0)).now).all()
    assert np.isfinite(selector.assess(level_ground, vehicle=(43.0, 0.5)).now).all()


@pytest.mark.parametrize("z", [-1500.0, 0.0, 1500.0])
def test_reach_is_the_same_wherever_heights_count_from(level_ground, z):
    """Over ground that is not seen the vehicle is as high as over all that is."""
    cells = lifted(level_ground, z)
    cells.known[:16] = cells.observed[:16] = False
    low, high = (
        LandingSiteSelector(by_risk()).assess(cells, vehicle=(z + 3.0 + up, 0.5, 8.0, 2.0)).now
        for up in (4.0, 9.0)
    )
    assert np.isnan(low).all() and np.hypot(high[0] - 8.0, high[1] - 2.0) <= 9.0


def test_land_now_does_not_climb():
    """No ground is safe but a plateau, which lies above the vehicle."""

    def plateau(x, y):
        return np.where(x > 9.0, 13.0, 0.5 * (np.floor(x) % 2) * (np.floor(y) % 2))

    cells = mapped(by_risk(), plateau, density=100.0).snapshot()
    selector = LandingSiteSelector(by_risk(dispersion=0.3))
    selector.land_now()
    found = selector.assess(cells, vehicle=(8.0, 0.5, 5.0, 8.0))
    assert found.selected.state is State.NOW and found.selected.position[2] < 1.0
    assert found.now[2] < 1.0


def test_land_now_heeds_keep_outs_and_takes_what_is_least_unsafe(with_block):
    """With a limit that no ground keeps there is no site, but a place to land if need be."""
    selector, here = LandingSiteSelector(by_risk(max_risk=0.0)), (12.0, 1.0, 8.0, 8.0)
    assert not selector.assess(with_block, vehicle=here).selected.id
    selector.land_now()
    first = selector.assess(with_block, vehicle=here).selected
    assert first.state is State.NOW and first.reason is Reason.LAND_NOW
    assert max(abs(first.position[:2] - 8.0)) > 1.5, "the block is no place to land"
    kept = around(first.position, 2.0)
    second = selector.assess(with_block, vehicle=here, keep_out=kept).selected
    assert second.reason is Reason.LAND_NOW and second.id != first.id
    assert np.abs(second.position[:2] - first.position[:2]).max() > 2.0
    none = selector.assess(with_block, vehicle=here, withheld="unreadable").selected
    assert none.reason is Reason.WITHHELD and not none.id


def test_covariance_is_that_of_drawn_maps():
    """Leaves drawn from their covariance, laid out and fitted again, scatter as it says."""
    cells = mapped(small(), lambda x, y: 0.1 * x - 0.05 * y, density=30.0).snapshot()
    x, y, radius = 6.5, 7.0, 1.5
    rng = np.random.default_rng(4)
    root = np.linalg.cholesky(cells.covariance_range)
    bases = np.array([tangent_basis(n) for n in cells.normal])
    drawn = []
    for _ in range(1500):
        error = np.einsum("kij,kj->ki", root, rng.standard_normal((len(cells.z), 3)))
        normal = cells.normal + np.einsum("kij,kj->ki", bases, error[:, :2])  # to first order
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        moved = dataclasses.replace(cells, normal=normal, z=cells.z + error[:, 2] / normal[:, 2])
        raster = rasterise(moved, LssConfig(max_gap=1.0))
        planes = ground_planes(raster.elevation, raster.seen, 0.5, radius)
        at = int(y / 0.5), int(x / 0.5)
        drawn.append([planes.elevation[at], planes.slope_y[at], -planes.slope_x[at]])
    pose_free = dataclasses.replace(cells, covariance_pose=np.zeros_like(cells.covariance_pose))
    claimed = ground_covariance(rasterise(pose_free, LssConfig(max_gap=1.0)), x, y, radius)
    scatter, claimed_part = np.cov(np.array(drawn).T), claimed[2:5, 2:5]
    np.testing.assert_allclose(scatter.diagonal(), claimed_part.diagonal(), rtol=0.15)
    both = (scatter, claimed_part)
    correlations = [of / np.sqrt(np.outer(of.diagonal(), of.diagonal())) for of in both]
    np.testing.assert_allclose(*correlations, atol=0.1)
    assert np.abs(correlations[1]).min() > 0.25  # each sign counts
    assert not claimed[:2].any()


def test_an_error_of_the_poses_moves_the_whole_ground():
    """It does not average out over the leaves under the lander."""
    cells = mapped(small(), flat(3.0), density=60.0).snapshot()
    common = np.zeros((len(cells.z), 3, 3))
    common[:, 2, 2] = 0.2**2
    common[:, 0, 0] = 0.01**2
    nothing = np.zeros_like(common)
    cells = dataclasses.replace(cells, covariance_pose=common, covariance_range=nothing)
    claimed = ground_covariance(rasterise(cells, LssConfig(max_gap=1.0)), 7.0, 7.0, 1.5)
    assert claimed[2, 2] == pytest.approx(0.2**2, rel=0.1)
    assert claimed[4, 4] == pytest.approx(0.01**2, rel=0.1)
    assert claimed[3, 3] < 1e-8
