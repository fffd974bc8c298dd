# SPDX-License-Identifier: Apache-2.0
"""The folder of a campaign."""

from __future__ import annotations

from quadtree_lss.lab.campaign.store import Store


def test_times_of_another_version_keep_their_columns(tmp_path):
    store = Store(tmp_path)
    store.note_time(0, {"cpu_s": 2.5, "process": 17})
    store.note_time(1, {"memory_mb": 240.0, "process": 18, "cpu_s": 2.25})
    assert store.times() == [
        {"index": "0", "cpu_s": "2.5", "process": "17"},
        {"index": "1", "cpu_s": "2.25", "process": "18"},
    ]
