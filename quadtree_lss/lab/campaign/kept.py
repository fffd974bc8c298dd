# SPDX-License-Identifier: Apache-2.0
"""One flight of a campaign flown again, with everything that there is to see of it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from quadtree_lss.lab.campaign.kinds import CampaignError, kind_of
from quadtree_lss.lab.campaign.store import Store
from quadtree_lss.lab.campaign.study import Study


def flagged(out: str | Path) -> list[int]:
    """The flights that the campaign's page names as the worst.

    Raises:
        CampaignError: there is no campaign.
    """
    try:
        worst = json.loads((Path(out) / "campaign.json").read_text("utf-8"))["worst"]
        return sorted({int(index) for pairs in worst.values() for index, _ in pairs})
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        msg = f"{out} is no folder of a campaign that was summed up"
        raise CampaignError(msg) from None


def keep(study: Study, out: str | Path, index: int) -> Path:
    """Flies flight ``index`` again; returns the folder with what it left.

    Raises:
        CampaignError: there is no such flight.
    """
    store = Store(out)
    with store.opened():
        count = replace(study, repeats=study.repeats + store.added()).count
    if not 0 <= index < count or (study.seeds and index >= study.count):
        msg = f"there is no flight {index}"
        raise CampaignError(msg)
    folder = store.out / "kept" / f"{index:06d}"
    kind_of(study.kind).keep(study.case(index), folder)
    return folder
