# SPDX-License-Identifier: Apache-2.0
"""The folder of a campaign."""

import json

import pytest

from quadtree_lss.lab.campaign.kinds import CampaignError, Case
from quadtree_lss.lab.campaign.store import Store

CASES = [Case(k, "map", "morpheus", 7106 + k, version="1", build="b") for k in range(4)]


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path / "c")
    for case in CASES[:3]:
        store.write(case, {"safe_found": 90.5, "b": 1, "a": None})
    return store


def test_a_record_is_read_as_it_was_written(store):
    record = store.read(CASES[1])
    assert list(record.figures) == ["safe_found", "b", "a"] and record.build == "b"
    assert store.read(CASES[3]) is None
    other = Case(1, "map", "morpheus", 7107, version="1", build="of other sources")
    assert store.read(other) is None


def edited(**new):
    return lambda text: json.dumps({**json.loads(text), **new}).encode()


@pytest.mark.parametrize(
    ("spoil", "word"),
    [
        (edited(index="1"), "not the record"),
        (edited(index=2), "not the record"),
        (edited(more=1), "not the record"),
        (lambda text: text[: len(text) // 2], "not the record"),
        (lambda text: b"", "not the record"),
        (lambda text: b"[" * 100_000, "not the record"),
    ],
)
def test_what_is_no_record_of_a_flight_is_named(store, spoil, word):
    path = store.path(CASES[1])
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(CampaignError, match=word) as caught:
        store.read(CASES[1])
    assert path.name in str(caught.value)
    assert store.read(CASES[0]) and store.read(CASES[2])
