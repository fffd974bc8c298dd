# SPDX-License-Identifier: Apache-2.0
"""A restored mapper goes on exactly as the one that was saved; nothing damaged is taken up."""

from __future__ import annotations

import dataclasses
import io
import tracemalloc
import zipfile

import numpy as np
import pytest
from core.builders import configured, make_pose, scan, scattered
from hypothesis import given, settings
from hypothesis import strategies as st

from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.checkpoint import CheckpointError, from_bytes, to_bytes

CONFIG = configured()


def ground(x, y):
    """A slope with two blocks on it, one at the border of what most scans see."""
    blocks = (np.hypot(x - 3.0, y - 4.0) < 1.0) | (np.hypot(x - 10.5, y - 2.0) < 0.8)
    return 0.1 * x - 0.05 * y + 0.5 * blocks


def flown(mapper: Mapper, scans: range) -> Mapper:
    """Sparse scans of rough ground: divisions, hints and features."""
    for number in scans:
        rng = np.random.default_rng(number)
        pose = make_pose(stamp_ns=1_000 + number)
        x, y = scattered(rng, 0.0, 0.0, 11.0 if number % 2 else 16.0, 1500 if number % 2 else 3)
        mapper.update(scan(ground, x, y, pose, 0.03, rng), pose)
    return mapper


def assert_same(one: CellMap, other: CellMap) -> None:
    for item in dataclasses.fields(CellMap):
        a, b = getattr(one, item.name), getattr(other, item.name)
        np.testing.assert_array_equal(a, b, err_msg=item.name)


@pytest.fixture(scope="module")
def content() -> bytes:
    """A checkpoint after some scans."""
    return to_bytes(flown(Mapper(CONFIG), range(5)).export_state())


def test_a_restored_mapper_goes_on_as_if_nothing_had_happened(content):
    whole = flown(Mapper(CONFIG), range(9))
    restored = Mapper(CONFIG)
    restored.import_state(from_bytes(content))
    known = restored.leaves.rows.known[: restored.leaves.count]
    assert set(known.tolist()) == {0, 1, 2, 3}, "the scene has leaves of every kind"
    flown(restored, range(5, 9))
    assert_same(restored.snapshot(), whole.snapshot())


def test_restoring_replaces_everything(content):
    other = flown(Mapper(CONFIG), range(20, 29))
    other.import_state(from_bytes(content))
    assert to_bytes(other.export_state()) == content


def test_an_export_does_not_change_with_the_mapper():
    mapper = flown(Mapper(CONFIG), range(2))
    state = mapper.export_state()
    before = to_bytes(state)
    flown(mapper, range(2, 6))
    assert to_bytes(state) == before


def test_an_empty_map_round_trips():
    mapper = flown(Mapper(CONFIG), range(3))
    mapper.import_state(from_bytes(to_bytes(Mapper(CONFIG).export_state())))
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
        mapper.import_state(from_bytes(bytes(damaged)))
    except CheckpointError as error:
        assert "\n" not in str(error)
        assert_same(mapper.snapshot(), before)
    else:
        assert to_bytes(mapper.export_state()) == content


def test_another_domain_is_refused_by_name(content):
    other = Mapper(configured(domain={"max_level": 7}))
    with pytest.raises(CheckpointError, match="another domain"):
        other.import_state(from_bytes(content))


def test_more_leaves_than_allowed_are_refused(content):
    with pytest.raises(CheckpointError, match=r"mapping\.max_cells"):
        Mapper(configured(mapping={"max_cells": 16})).import_state(from_bytes(content))


def _overlapping(state):
    state["leaves"]["ix"][0] += 1


def _elsewhere(state):
    state["leaves"]["level"][:] = 31


def _negative(state):
    state["leaves"]["iy"][0] = -1


def _one_leaf_less(state):
    state["leaves"] = state["leaves"][:-1]


def _without(state):
    del state["leaves"]


def _other_kind(state):
    state["observed"] = state["observed"].astype(np.float32)


def _other_columns(state):
    state["leaves"] = state["leaves"][["level", "ix", "iy"]].copy()


def _downward(state):
    state["leaves"]["normal"] *= -1.0


def _infinite(state):
    state["leaves"]["pose_part"] = np.inf


def _certain(state):
    state["leaves"]["range_part"] = 0.0


def _unheard_of(state):
    state["leaves"]["known"] = 4


def _unseen(state):
    state["observed"] = state["observed"][:-1]


def _beyond_seen(state):
    state["observed"][3] = 4


def _without_bottom(state):
    state["leaves"]["low"] = -np.inf


def _no_height(state):
    state["leaves"]["high"] = np.nan


def _far_off(state):
    state["offset"] = np.array([np.inf, 1.0])


def _two_stamps(state):
    state["stamp_ns"] = np.zeros(2, dtype=np.int64)


SPOILS = [
    _overlapping,
    _elsewhere,
    _negative,
    _one_leaf_less,
    _without,
    _other_kind,
    _other_columns,
    _downward,
    _infinite,
    _certain,
    _unheard_of,
    _unseen,
    _beyond_seen,
    _without_bottom,
    _no_height,
    _far_off,
    _two_stamps,
]


@pytest.mark.parametrize("spoil", SPOILS)
def test_inconsistent_states_are_refused_and_the_map_kept(content, spoil):
    state = from_bytes(content)
    spoil(state)
    mapper = flown(Mapper(CONFIG), range(2))
    before = mapper.snapshot()
    with pytest.raises(CheckpointError):
        mapper.import_state(state)
    assert_same(mapper.snapshot(), before)


def test_other_archives_are_no_checkpoints(tmp_path):
    np.savez(tmp_path / "a.npz", x=np.arange(3))
    with pytest.raises(CheckpointError, match="version"):
        Mapper(CONFIG).import_state(from_bytes((tmp_path / "a.npz").read_bytes()))
    np.save(tmp_path / "b.npy", np.arange(3))
    with pytest.raises(CheckpointError):
        from_bytes((tmp_path / "b.npy").read_bytes())


def test_a_small_file_that_means_gigabytes_is_refused_unread(content):
    """A stored archive cannot hold more than its size; a compressed one is none of ours."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        with archive.open("leaves.npy", "w", force_zip64=True) as part:
            for _ in range(256):
                part.write(bytes(1 << 20))
    bomb = out.getvalue()
    assert len(bomb) < 3e6
    tracemalloc.start()
    with pytest.raises(CheckpointError, match="compressed"):
        from_bytes(bomb)
    assert tracemalloc.get_traced_memory()[1] < 1e7
    tracemalloc.stop()


def test_an_archive_that_claims_more_than_its_size_is_refused(content):
    claimed = bytearray(content)
    place = claimed.rindex(b"PK\x01\x02") + 24  # of the last part: its size unpacked
    claimed[place : place + 4] = (2**31).to_bytes(4, "little")
    with pytest.raises(CheckpointError):
        from_bytes(bytes(claimed))


@pytest.mark.slow
def test_no_damage_gets_through(content):
    """Bytes changed, cut out, doubled and exchanged, 20,000 times."""
    rng = np.random.default_rng(17)
    mapper = Mapper(CONFIG)
    whole = np.frombuffer(content, dtype=np.uint8)
    for _ in range(20_000):
        damaged = whole.copy()
        place = int(rng.integers(len(damaged)))
        end = min(place + int(2 ** rng.uniform(0, 12)), len(damaged))
        kind = rng.integers(3)
        if kind == 0:
            damaged[place:end] ^= rng.integers(1, 256, end - place, dtype=np.uint8)
        elif kind == 1:
            damaged = np.delete(damaged, slice(place, end))
        else:
            damaged = np.insert(damaged, place, damaged[place:end])
        try:
            mapper.import_state(from_bytes(damaged.tobytes()))
        except CheckpointError as error:
            assert str(error).isprintable()
        else:
            assert to_bytes(mapper.export_state()) == content
