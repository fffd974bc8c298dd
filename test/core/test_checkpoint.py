# SPDX-License-Identifier: Apache-2.0
"""A restored mapper goes on exactly as the one that was saved; nothing damaged is taken up."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from core.builders import configured, make_pose, scan, scattered
from hypothesis import given, settings
from hypothesis import strategies as st

from quadtree_lss.core.mapping.mapper import Mapper
from quadtree_lss.core.tree.cell_map import CellMap
from quadtree_lss.core.tree.checkpoint import (
    CheckpointError,
    export_checkpoint,
    from_bytes,
    restore,
    to_bytes,
)

CONFIG = configured()


def ground(x, y):
    """A slope with a block on it."""
    return 0.1 * x - 0.05 * y + 0.5 * (np.hypot(x - 3.0, y - 4.0) < 1.0)


def flown(mapper: Mapper, scans: range) -> Mapper:
    """Sparse scans of rough ground: divisions, stored points and features."""
    for number in scans:
        rng = np.random.default_rng(number)
        pose = make_pose(stamp_ns=1_000 + number)
        x, y = scattered(rng, 0.0, 0.0, 11.0 if number % 2 else 16.0, 1500 if number % 2 else 15)
        mapper.update(scan(ground, x, y, pose, 0.03, rng), pose)
    return mapper


def assert_same(one: CellMap, other: CellMap) -> None:
    for item in dataclasses.fields(CellMap):
        a, b = getattr(one, item.name), getattr(other, item.name)
        np.testing.assert_array_equal(a, b, err_msg=item.name)


@pytest.fixture(scope="module")
def content() -> bytes:
    """A checkpoint after some scans."""
    return to_bytes(export_checkpoint(flown(Mapper(CONFIG), range(5))))


def test_a_restored_mapper_goes_on_as_if_nothing_had_happened(content):
    whole = flown(Mapper(CONFIG), range(9))
    restored = Mapper(CONFIG)
    restore(restored, from_bytes(content))
    assert len(restored._stored.row), "the scene leaves points stored"
    flown(restored, range(5, 9))
    assert_same(restored.snapshot(), whole.snapshot())


def test_restoring_replaces_everything(content):
    other = flown(Mapper(CONFIG), range(20, 29))
    restore(other, from_bytes(content))
    assert to_bytes(export_checkpoint(other)) == content


def test_an_export_does_not_change_with_the_mapper():
    mapper = flown(Mapper(CONFIG), range(2))
    state = export_checkpoint(mapper)
    before = to_bytes(state)
    flown(mapper, range(2, 6))
    assert to_bytes(state) == before


def test_an_empty_map_round_trips():
    mapper = flown(Mapper(CONFIG), range(3))
    restore(mapper, from_bytes(to_bytes(export_checkpoint(Mapper(CONFIG)))))
    assert_same(mapper.snapshot(), Mapper(CONFIG).snapshot())


@settings(max_examples=60, deadline=None)
@given(st.floats(0.0, 1.0, exclude_max=True))
def test_a_file_cut_short_is_refused(content, share):
    with pytest.raises(CheckpointError):
        from_bytes(content[: int(share * len(content))])


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 255))
def test_damage_is_refused_or_harmless(content, place, change):
    damaged = bytearray(content)
    damaged[place % len(damaged)] ^= change
    mapper = flown(Mapper(CONFIG), range(1))
    before = mapper.snapshot()
    try:
        restore(mapper, from_bytes(bytes(damaged)))
    except CheckpointError as error:
        assert "\n" not in str(error)
        assert_same(mapper.snapshot(), before)
    else:
        assert to_bytes(export_checkpoint(mapper)) == content


def test_another_domain_is_refused_by_name(content):
    other = Mapper(configured(domain={"max_level": 7}))
    with pytest.raises(CheckpointError, match="another domain"):
        restore(other, from_bytes(content))


def test_more_leaves_than_allowed_are_refused(content):
    with pytest.raises(CheckpointError, match=r"mapping\.max_cells"):
        restore(Mapper(configured(mapping={"max_cells": 16})), from_bytes(content))


def _overlapping(state):
    state["leaves.ix"][0] += 1


def _elsewhere(state):
    state["leaves.level"][:] = 31


def _short(state):
    state["leaves.z"] = state["leaves.z"][:-1]


def _without(state):
    del state["leaves.parts"]


def _other_kind(state):
    state["leaves.z"] = state["leaves.z"].astype(np.float32)


def _downward(state):
    state["leaves.normal"][:] *= -1.0


def _infinite(state):
    state["leaves.parts"][:] = np.inf


def _homeless(state):
    state["stored.row"][:] = 10**6


def _unseen(state):
    state["observed"] = state["observed"][:-1]


def _of_no_scan(state):
    state["stored.keys"] = state["stored.keys"][:-1]


def _scan_still_to_come(state):
    state["stored.next_scan"] = np.zeros_like(state["stored.next_scan"])


def _nowhere(state):
    state["stored.points"][2, 0] = np.nan


def _offset_of_a_plane(state):
    state["alignment.mean"] = np.zeros(3)


def _offset_unknown(state):
    state["alignment.mean"][1] = np.nan


def _covariance_of_rows(state):
    state["alignment.covariance"] = np.eye(6)[:2]


def _negative_variance(state):
    state["alignment.covariance"][2, 2] = -1.0


def _never_other(state):
    state["alignment.persistence"] = np.array(1.0)


@pytest.mark.parametrize(
    "spoil",
    [
        _overlapping,
        _elsewhere,
        _short,
        _without,
        _other_kind,
        _downward,
        _infinite,
        _homeless,
        _unseen,
        _of_no_scan,
        _scan_still_to_come,
        _nowhere,
        _offset_of_a_plane,
        _offset_unknown,
        _covariance_of_rows,
        _negative_variance,
        _never_other,
    ],
)
def test_inconsistent_states_are_refused_and_the_map_kept(content, spoil):
    state = from_bytes(content)
    spoil(state)
    mapper = flown(Mapper(CONFIG), range(2))
    before = mapper.snapshot()
    with pytest.raises(CheckpointError):
        restore(mapper, state)
    assert_same(mapper.snapshot(), before)


def test_other_archives_are_no_checkpoints(tmp_path):
    np.savez(tmp_path / "a.npz", x=np.arange(3))
    with pytest.raises(CheckpointError, match="version"):
        restore(Mapper(CONFIG), from_bytes((tmp_path / "a.npz").read_bytes()))
    np.save(tmp_path / "b.npy", np.arange(3))
    with pytest.raises(CheckpointError):
        from_bytes((tmp_path / "b.npy").read_bytes())
