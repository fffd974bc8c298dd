# SPDX-License-Identifier: Apache-2.0
"""The target: its transitions, the rule of the divert, and numbers that last as long as places."""

import dataclasses

import numpy as np
import pytest
from core.builders import mapped
from core.kernels import tangent_basis
from core.scenes import flat
from core.test_sites import small
from hypothesis import given, settings
from hypothesis import strategies as st

from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing import choose as choosing
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.landing.choose import ground_covariance
from quadtree_lss.onboard.core.landing.lattice import ground_planes
from quadtree_lss.onboard.core.landing.ranking import Candidates
from quadtree_lss.onboard.core.landing.raster import rasterise
from quadtree_lss.onboard.core.landing.result import no_target, shown
from quadtree_lss.onboard.core.landing.target import (
    DISTANCE_COST,
    GAIN_AND_COST,
    KEEP_RISK_FACTOR,
    Choice,
    Descent,
    Reason,
    Request,
    Situation,
    State,
    TargetKeeper,
)

NAN = np.nan
LSS = LssConfig()
AXIS = 10.0 * np.arange(4.0)
HIGH, LOW = Descent(200.0, 4.0), Descent(LSS.commit_height - 1.0, 2.0)


def candidates(unsafe, safe=(1, 1, 1, 1), risk=0.0, axis=AXIS):
    """A row of grid points with P(unsafe | aim), NaN where landing is not permitted."""
    unsafe, safe = np.array([unsafe], dtype=np.float64), np.array([safe], dtype=bool)
    cost = np.where(safe, unsafe, NAN)
    safe = safe & np.isfinite(unsafe)
    return Candidates(axis, np.zeros(1), safe, cost, np.full(cost.shape, risk), unsafe)


def situation(unsafe=(0.02,) * 4, *, confirmed=(1, 1, 1, 1), fault=Reason.HAZARD, **given):
    about = {"descent": HIGH, "settled": True, "now": None}
    about |= {name: given.pop(name) for name in about.keys() & given.keys()}
    ground = candidates(unsafe, **given)
    about["before"] = dataclasses.replace(ground, safe=np.array([confirmed], dtype=bool))
    return Situation(ground, LSS, lambda *_: fault, Reason.NO_SITE, **about)


NOTHING, RELEASE, NOW = Request.NONE, Request.RELEASE, Request.LAND_NOW
TWO = (0.02, 0.03, 0.02, 0.02)
LOST = {"unsafe": (0.02, 0.3, 0.02, 0.02), "safe": (1, 0, 1, 1)}
RISKY = {"unsafe": (NAN, 0.05, NAN, NAN), "safe": (0, 0, 0, 0)}
MORE = KEEP_RISK_FACTOR * LSS.max_risk
#: State, request and column of the target before; the situation; state, column and reason after.
TRANSITIONS = [
    (State.NONE, NOTHING, None, {"safe": (0, 0, 0, 0)}, State.NONE, None, Reason.NO_SITE),
    (State.NONE, NOTHING, None, {"settled": False}, State.SETTLING, None, Reason.SETTLING),
    (State.SETTLING, NOTHING, None, {"unsafe": (0.2,) * 4}, State.NONE, None, Reason.UNLIKELY),
    (State.SETTLING, NOTHING, None, {"confirmed": (0,) * 4}, State.NONE, None, Reason.UNCONFIRMED),
    (State.SETTLING, NOTHING, None, {}, State.HOLDS, 0, Reason.FIRST),
    (State.NONE, NOTHING, None, {"confirmed": (0, 0, 1, 0)}, State.HOLDS, 2, Reason.FIRST),
    (State.NONE, RELEASE, None, {"settled": False}, State.HOLDS, 0, Reason.FIRST),
    (State.NONE, NOTHING, None, {"settled": False, "descent": LOW},
     State.COMMITTED, 0, Reason.FIRST),
    (State.HOLDS, NOTHING, 1, {"settled": False}, State.HOLDS, 1, Reason.HOLDS),
    (State.HOLDS, NOTHING, 1, {"unsafe": (0.08, 0.08, 0.08, 0.03)}, State.HOLDS, 3, Reason.BETTER),
    (State.HOLDS, NOTHING, 1, {"unsafe": (0.05, 0.2, 0.2, 0.2)}, State.HOLDS, 0, Reason.BETTER),
    (State.HOLDS, NOTHING, 1, {"unsafe": (0.2,) * 4}, State.NONE, None, Reason.UNLIKELY),
    (State.HOLDS, NOTHING, 1, LOST, State.NONE, None, Reason.HAZARD),
    (State.HOLDS, NOTHING, 1, LOST | {"fault": Reason.KEEP_OUT}, State.NONE, None, Reason.KEEP_OUT),
    (State.HOLDS, NOTHING, 1, RISKY | {"risk": 0.9 * MORE}, State.HOLDS, 1, Reason.HOLDS),
    (State.HOLDS, NOTHING, 1, RISKY | {"risk": 1.1 * MORE}, State.NONE, None, Reason.HAZARD),
    (State.HOLDS, NOTHING, 1, RISKY | {"unsafe": (0.02, 0.05, NAN, NAN), "safe": (1, 0, 0, 0)},
     State.HOLDS, 0, Reason.BETTER),
    (State.HOLDS, NOTHING, 9, {}, State.NONE, None, Reason.OUTSIDE_MAP),
    (State.HOLDS, NOTHING, 1, {"descent": LOW}, State.COMMITTED, 1, Reason.HOLDS),
    (State.HOLDS, RELEASE, 1, {"unsafe": TWO, "settled": False}, State.HOLDS, 0, Reason.RELEASED),
    (State.HOLDS, NOW, 1, {"now": candidates(TWO)}, State.NOW, 0, Reason.LAND_NOW),
    (State.COMMITTED, NOTHING, 1, {"unsafe": (0.0, 0.09, 0.0, 0.0), "descent": LOW},
     State.COMMITTED, 1, Reason.HOLDS),
    (State.COMMITTED, NOTHING, 1, {"unsafe": (0.0, 0.5, 0.0, 0.0), "descent": LOW},
     State.COMMITTED, 1, Reason.HOLDS),
    (State.COMMITTED, NOTHING, 1, RISKY | {"risk": 0.1, "descent": LOW},
     State.COMMITTED, 1, Reason.HOLDS),
    (State.COMMITTED, NOTHING, 1, LOST | {"descent": LOW}, State.NONE, None, Reason.HAZARD),
    (State.COMMITTED, NOTHING, 1, {}, State.HOLDS, 1, Reason.HOLDS),
    (State.COMMITTED, RELEASE, 1, {"unsafe": TWO, "descent": LOW},
     State.COMMITTED, 0, Reason.RELEASED),
    (State.NOW, NOTHING, None, {}, State.NOW, None, Reason.NO_SITE),
    (State.NOW, NOTHING, None, {"now": candidates(TWO)}, State.NOW, 0, Reason.LAND_NOW),
    (State.NOW, NOTHING, 1, {"now": candidates((0.02,) * 4)}, State.NOW, 1, Reason.HOLDS),
    (State.NOW, NOTHING, 1, LOST | {"now": candidates((0.3, 0.3, 0.3, 0.05))},
     State.NOW, 3, Reason.BETTER),
    (State.NOW, NOTHING, 1, LOST | {"now": candidates(TWO), "fault": Reason.KEEP_OUT},
     State.NOW, 0, Reason.LAND_NOW),
    (State.NOW, NOTHING, 1, {"unsafe": (0.0, 0.09, 0.0, 0.0), "now": candidates((0.0,) * 4),
                             "descent": LOW}, State.NOW, 1, Reason.HOLDS),
    (State.NOW, RELEASE, 1, {"unsafe": TWO}, State.HOLDS, 0, Reason.RELEASED),
]  # fmt: skip


@pytest.mark.parametrize(("state", "asked", "column", "given", "then", "to", "reason"), TRANSITIONS)
def test_transition(state, asked, column, given, then, to, reason):
    held = None if column is None else (10.0 * column, 0.0)
    found = situation(**given).transition(state, asked, held)
    assert found == (then, None if to is None else (0, to), reason)


@pytest.mark.parametrize(("steps", "reason"), [(1, Reason.HAZARD), (2, Reason.HOLDS)])
def test_risky_ground_within_half_of_the_margin_withdraws_the_target(steps, reason):
    """A margin of two grid points."""
    lss = dataclasses.replace(LSS, margin=20.0, grid_spacing=10.0)
    given_ = dataclasses.replace(situation(**RISKY, fault=Reason.HAZARD), lss=lss)
    given_.ground.risk[0, 1 + steps] = 2.0 * MORE
    assert given_.transition(State.HOLDS, NOTHING, (10.0, 0.0))[2] is reason


@pytest.mark.parametrize(
    ("state", "committed"), [(State.HOLDS, LSS.commit_height), (State.NOW, 0.0)]
)
@settings(max_examples=200)
@given(
    st.lists(st.floats(0.0, 0.099), min_size=4, max_size=4),
    st.floats(0.5, 300.0),
    st.floats(0.5, 40.0),
    st.floats(1.0, 4.0),
)
def test_a_divert_needs_more_gain_than_it_costs(state, committed, unsafe, left, speed, riskier):
    """Against the formula at each grid point. After "land now" the vehicle diverts also when it is
    low, from ground that is too risky for a site."""
    share, least = GAIN_AND_COST["probability"]
    unsafe = np.array(unsafe) * (riskier if state is State.NOW else 1.0)
    descent = Descent(committed + left, speed)
    given_ = situation(unsafe, descent=descent, now=candidates(unsafe))
    reach = min(left, 0.25 * (left / speed) ** 2)
    away = np.abs(AXIS - AXIS[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        cost = np.where(away < reach, least / (1.0 - away / reach), np.inf)
    worth = share * (unsafe[1] - unsafe) - cost
    if given_.is_low and unsafe[1] <= 1.0 - LSS.min_probability:
        worth[:] = -1.0
    _, place, reason = given_.transition(state, NOTHING, (10.0, 0.0))
    assert (reason is Reason.BETTER) == (worth.max() > 0.0)
    assert place == (0, int(np.argmax(worth)) if worth.max() > 0.0 else 1)


def test_reach_is_that_of_speeding_up_and_slowing_down_aside():
    """Against the integrated path: half of the time at 1 m/s^2, half at -1 m/s^2."""
    time, steps = np.linspace(0.0, 8.0, 8001, retstep=True)
    speed = np.cumsum(np.where(time < 4.0, 1.0, -1.0)) * steps
    assert Descent(80.0, 10.0).reach == pytest.approx(np.sum(speed) * steps, rel=2e-3)
    assert Descent(10.0, 0.0).reach == 10.0, "not more steeply than 45 degrees"
    assert Descent(-1.0, 1.0).reach == 0.0


def choose(keeper: TargetKeeper, *unsafe, **given) -> Choice:
    """Return the last choice over some assessments."""
    for each in unsafe:
        ground = candidates(each, np.isfinite(each), **given)
        choice = keeper.choose(Situation(ground, LSS, lambda *_: Reason.HAZARD, Reason.NO_SITE))
    return choice


@settings(max_examples=200)
@given(st.lists(st.lists(st.sampled_from([NAN, 0.0, 0.02, 0.05, 0.5]), min_size=4, max_size=4)))
def test_no_change_without_cause(rows):
    """On any sequence: confirmed ground, withdrawn when lost, changed only for the gain."""
    keeper, last, before = TargetKeeper(), Choice(None, 0, Reason.UNCONFIRMED), None
    share, least = GAIN_AND_COST["probability"]
    for row in rows:
        choice = choose(keeper, row)
        assert (choice.point is None) == (choice.reason >= 16) == (choice.id == 0)
        if choice.point is not None:
            assert row[choice.point[1]] <= 0.1 and np.isfinite(before[choice.point[1]])
        if last.point is not None:
            held = row[last.point[1]]
            if choice.point is None:
                assert not held <= 0.1
            elif choice.point != last.point:
                assert share * (held - row[choice.point[1]]) > least
                assert choice.reason is Reason.BETTER and choice.id != last.id
            else:
                assert choice.id == last.id
        last, before = choice, row


def test_a_number_is_never_given_twice_and_lasts_as_long_as_safe_ground():
    keeper, row = TargetKeeper(), (0.03, 0.02, 0.03, 0.03)
    assert choose(keeper, row, row).id == 1
    assert choose(keeper, (0.03, NAN, 0.03, 0.02)).reason is Reason.HAZARD
    assert choose(keeper, (0.03, NAN, 0.03, 0.02)).id == 2
    assert choose(keeper, row, row).id == 3
    keeper.release()
    assert choose(keeper, row) == Choice((0, 1), 3, Reason.RELEASED, State.HOLDS)
    moved = choose(keeper, row, axis=AXIS + 5.0)
    assert moved.reason is Reason.OUTSIDE_MAP and moved.best == (0, 1)


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


@pytest.mark.parametrize(
    ("where", "reason", "pending"),
    [
        ({"keep_outs": "around"}, Reason.KEEP_OUT, True),
        ({"why_withheld": "the map is too old"}, Reason.WITHHELD, False),
        ({"keep_outs": [[(0.0, 0.0)]]}, Reason.WITHHELD, False),
    ],
)
def test_a_withdrawn_target_says_why(level_ground, where, reason, pending):
    selector = LandingSiteSelector(small())
    place = target_of(selector, level_ground).selected.position
    if where.get("keep_outs") == "around":
        where = {"keep_outs": [around((2.0, 2.0), 1.0), around(place, 1.0)]}
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
    monkeypatch.setitem(DISTANCE_COST, "score", 0.1)
    selector = LandingSiteSelector(small())
    held = target_of(selector, level_ground, area=around((8.0, 8.0), 8.0)).selected
    for half in (7.0, 6.0):
        area, aim = around(held.position, half), held.position[:2] + 0.3
        found = selector.assess(level_ground, area=area, target=aim).selected
        assert (found.id, found.reason) == (held.id, Reason.HOLDS)
    # Another area without its zone, and another preferred place, request another choice.
    other = around(held.position + 4.0, 3.0)
    assert selector.assess(level_ground, area=other).selected.reason is Reason.RELEASED
    moved = selector.assess(level_ground, target=(4.0, 4.0)).selected
    assert moved.reason is Reason.RELEASED and np.hypot(*(moved.position[:2] - 4.0)) < 1.0


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


def test_why_is_one_sentence_for_each_reason(level_ground, with_block):
    selector = LandingSiteSelector(by_risk(min_probability=0.99))
    found = target_of(selector, level_ground)
    assert found.why == f"target 1 ({shown(found.selected.probability)}): first choice"
    for reason in Reason:
        none = dataclasses.replace(found, selected=no_target(reason, probability=0.961))
        assert none.why.startswith("no target: ") and not set("\n_") & set(none.why)
    none = dataclasses.replace(found, selected=no_target(Reason.UNLIKELY, probability=0.961))
    assert none.why == "no target: best grid point 96.1 %, required 99 %"
    none = LandingSiteSelector(by_risk(max_risk=0.0)).assess(with_block)
    assert none.selected.reason is Reason.NO_SITE
    assert none.why.endswith("but none has a risk of at most 0 % and 0 m of margin")
    other = dataclasses.replace(found.sites, id=found.sites.id + 1)
    other = dataclasses.replace(selector.assess(level_ground), sites=other)
    assert other.why.endswith("0.0 m away) gains less than the divert costs")


def test_land_now_takes_the_best_within_reach_at_once(monkeypatch, with_block):
    """Before anything is settled, and low: only what lies near enough, until it is released."""
    monkeypatch.setattr(choosing, "SETTLE_SHARE", 1.1)
    monkeypatch.setitem(DISTANCE_COST, "probability", 0.0)
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
    assert found.now[3] == pytest.approx(within.max(), abs=1e-4)  # clearance decides between equals
    selector.release()
    assert selector.assess(with_block, vehicle=low).selected.reason is Reason.RELEASED


def test_land_now_heeds_keep_outs_and_takes_what_is_least_unsafe(with_block):
    """With a limit that no ground keeps there is no site, but a place to land if need be."""
    selector, here = LandingSiteSelector(by_risk(max_risk=0.0)), (12.0, 1.0, 8.0, 8.0)
    assert not selector.assess(with_block, vehicle=here).selected.id
    selector.land_now()
    first = selector.assess(with_block, vehicle=here).selected
    assert first.state is State.NOW and first.reason is Reason.LAND_NOW
    assert max(abs(first.position[:2] - 8.0)) > 1.5, "the block is no place to land"
    kept = around(first.position, 2.0)
    second = selector.assess(with_block, vehicle=here, keep_outs=[kept]).selected
    assert second.reason is Reason.LAND_NOW and second.id != first.id
    assert np.abs(second.position[:2] - first.position[:2]).max() > 2.0
    none = selector.assess(with_block, vehicle=here, why_withheld="unreadable").selected
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
        planes = ground_planes(raster.elevation, raster.observed, 0.5, radius)
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


def test_land_now_does_not_climb():
    """Only a plateau above the vehicle is safe."""

    def plateau(x, y):
        return np.where(x > 9.0, 13.0, 0.5 * (np.floor(x) % 2) * (np.floor(y) % 2))

    cells = mapped(by_risk(), plateau, density=100.0).snapshot()
    selector = LandingSiteSelector(by_risk(dispersion=0.3))
    selector.land_now()
    found = selector.assess(cells, vehicle=(8.0, 0.5, 5.0, 8.0))
    assert found.selected.state is State.NOW and found.selected.position[2] < 1.0
    assert found.now[2] < 1.0
