# SPDX-License-Identifier: Apache-2.0
"""The folder of a campaign."""

import json

import pytest

from quadtree_lss.lab.campaign.engine import key_of, read_record, record_path, write_record
from quadtree_lss.lab.campaign.kinds import CampaignError, Case

CASES = [Case(k, "map", "morpheus", 7106 + k, version="1", build="b") for k in range(4)]


@pytest.fixture
def folder(tmp_path):
    for case in CASES[:3]:
        write_record(tmp_path, case, {"safe_found": 90.5, "b": 1, "a": None})
    return tmp_path


def test_a_record_is_read_as_it_was_written(folder):
    record = read_record(folder, CASES[1])
    assert list(record.figures) == ["safe_found", "b", "a"] and record.build == "b"
    assert read_record(folder, CASES[3]) is None
    other = Case(1, "map", "morpheus", 7107, version="1", build="of other sources")
    assert read_record(folder, other) is None


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
def test_what_is_no_record_of_a_flight_is_named(folder, spoil, word):
    path = record_path(folder, 1, key_of(CASES[1]))
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(CampaignError, match=word) as caught:
        read_record(folder, CASES[1])
    assert path.name in str(caught.value)
    assert read_record(folder, CASES[0]) and read_record(folder, CASES[2])
