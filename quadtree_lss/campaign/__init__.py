# SPDX-License-Identifier: Apache-2.0
"""Many flights: simulated, mapped and scored."""

from quadtree_lss.campaign.seed_summary import SeedsResult
from quadtree_lss.campaign.seeds import FlightOptions, evaluate_seeds, parse_seeds

__all__ = ["FlightOptions", "SeedsResult", "evaluate_seeds", "parse_seeds"]
