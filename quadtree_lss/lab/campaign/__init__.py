# SPDX-License-Identifier: Apache-2.0
"""Studies of many flights, flown on one computer or many."""

from quadtree_lss.lab.campaign.engine import Where, campaign
from quadtree_lss.lab.campaign.kinds import CampaignError, Case, Flown, Kind, Quantity
from quadtree_lss.lab.campaign.paired import compare_campaigns
from quadtree_lss.lab.campaign.study import Study, read_study
from quadtree_lss.lab.campaign.summary import CampaignResult

__all__ = [
    "CampaignError",
    "CampaignResult",
    "Case",
    "Flown",
    "Kind",
    "Quantity",
    "Study",
    "Where",
    "campaign",
    "compare_campaigns",
    "read_study",
]
