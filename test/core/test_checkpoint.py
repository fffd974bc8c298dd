# SPDX-License-Identifier: Apache-2.0
"""A restored mapper continues exactly as the one that was saved; damaged states are rejected."""

import io

import numpy as np
import pytest
from core.builders import assert_same, configured, look
from core.scenes import make_pose, scattered

from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.tree.checkpoint import CheckpointError, from_file, to_bytes

CONFIG = configured()


def ground(x, y):
    """A slope with two blocks on it, one at the border of what most scans see."""
    blocks = (np.hypot(x - 3.0, y - 4.0) < 1.0) | (np.hypot(x - 10.5, y - 2.0) < 0.8)
    return 0.1 * x - 0.05 * y + 0.5 * blocks


def flown(mapper: Mapper, scans: range) -> Mapper:
    """Sparse scans of rough ground: divisions, hints and features."""
    for number in scans:
        rng = np.random.default_rng(number)
        x, y = scattered(rng, 0.0, 0.0, 11.0 if number % 2 else 16.0, 1500 if number % 2 else 3)
        look(mapper, ground, x, y, rng, 0.03, make_pose(stamp_ns=1_000 + number))
    return mapper


@pytest.fixture(scope="module")
def content() -> bytes:
    """A checkpoint after some scans."""
    return to_bytes(flown(Mapper(CONFIG), range(5)).export_state())


def test_a_restored_mapper_goes_on_as_if_nothing_had_happened(content):
    whole = flown(Mapper(CONFIG), range(9))
    restored = Mapper(CONFIG)
    restored.import_state(from_file(io.BytesIO(content)))
    known = restored.leaves.rows.state[: restored.leaves.count]
    assert set(known.tolist()) == {0, 1, 2, 3}, "the scene has leaves of every kind"
    flown(restored, range(5, 9))
    assert_same(restored.snapshot(), whole.snapshot())


def test_restoring_replaces_everything(content):
    other = flown(Mapper(CONFIG), range(20, 29))
    other.import_state(from_file(io.BytesIO(content)))
    assert to_bytes(other.export_state()) == content


def test_an_export_does_not_change_with_the_mapper():
    mapper = flown(Mapper(CONFIG), range(2))
    state = mapper.export_state()
    before = to_bytes(state)
    flown(mapper, range(2, 6))
    assert to_bytes(state) == before


def test_a_state_of_another_format_is_refused_by_its_number(content):
    state = from_file(io.BytesIO(content))
    state["format"] = state["format"] - 1
    del state["pending_offset"]
    with pytest.raises(CheckpointError, match="is not a checkpoint of this version"):
        Mapper(CONFIG).import_state(state)


def test_more_leaves_than_allowed_are_refused(content):
    with pytest.raises(CheckpointError, match=r"mapping\.max_cells"):
        Mapper(configured(mapping={"max_cells": 16})).import_state(from_file(io.BytesIO(content)))


def put(name, value, column=None, at=...):
    """Sets some of an array of a state, or of a column of its leaves."""

    def spoil(state):
        (state[name] if column is None else state[name][column])[at] = value

    return spoil


def become(name, change):
    """Replaces an array of a state by what is made of it."""
    return lambda state: state.update({name: change(state[name])})


SPOILS = {
    "overlapping": put("leaves", 3, "ix", 0),
    "elsewhere": put("leaves", 31, "level"),
    "negative": put("leaves", -1, "iy", 0),
    "one leaf less": become("leaves", lambda leaves: leaves[:-1]),
    "without": lambda state: state.pop("leaves"),
    "another kind": become("observed", lambda observed: observed.astype(np.float32)),
    "other columns": become("leaves", lambda leaves: leaves[["level", "ix", "iy"]].copy()),
    "downward": put("leaves", (0.0, 0.0, -1.0), "normal"),
    "infinite": put("leaves", np.inf, "pose_part"),
    "unheard of": put("leaves", 4, "state"),
    "unseen": become("observed", lambda observed: observed[:-1]),
    "two stamps": become("stamp_ns", lambda _: np.zeros(2, dtype=np.int64)),
}


@pytest.mark.parametrize("spoil", SPOILS.values(), ids=SPOILS)
def test_inconsistent_states_are_refused_and_the_map_kept(content, spoil):
    state = from_file(io.BytesIO(content))
    spoil(state)
    mapper = flown(Mapper(CONFIG), range(2))
    before = mapper.snapshot()
    with pytest.raises(CheckpointError):
        mapper.import_state(state)
    assert_same(mapper.snapshot(), before)
