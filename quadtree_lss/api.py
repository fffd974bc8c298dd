# SPDX-License-Identifier: Apache-2.0
"""Public Python interface: from a bag to a map to landing sites. See ``docs/api.md``.

Each command of ``quadtree-lss`` calls one of these functions, which returns a result object.
"""

from quadtree_lss.desk.bags.bag import Bag, BagError
from quadtree_lss.desk.exchange.dem import ElevationModel
from quadtree_lss.desk.exchange.saved import Grid, Results, ResultsError, load_results
from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.desk.replay.differences import Comparison, compare_results
from quadtree_lss.desk.replay.elevation_model import rank_sites
from quadtree_lss.desk.replay.export import export_results
from quadtree_lss.desk.replay.files import ReplayError
from quadtree_lss.desk.replay.info import BagInfo, inspect_bag
from quadtree_lss.desk.replay.replay import Step, replay, scans, steps
from quadtree_lss.desk.replay.results import ReplayResult
from quadtree_lss.desk.replay.suggest import Suggestion, suggest_config
from quadtree_lss.onboard.config.settings import Config, ConfigError
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.landing.result import LandingAssessment, Sites
from quadtree_lss.onboard.core.mapping.mapper import Mapper, ScanReport
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.tree.cell_map import CellMap, Ground
from quadtree_lss.onboard.errors import QuadtreeLssError
from quadtree_lss.onboard.messages.intake import ReadyScan

__all__ = [
    "Bag",
    "BagError",
    "BagInfo",
    "CellMap",
    "Comparison",
    "Config",
    "ConfigError",
    "ElevationModel",
    "Grid",
    "Ground",
    "LandingAssessment",
    "LandingSiteSelector",
    "Mapper",
    "Pose",
    "QuadtreeLssError",
    "ReadyScan",
    "ReplayError",
    "ReplayResult",
    "Results",
    "ResultsError",
    "ScanReport",
    "Sites",
    "Step",
    "Suggestion",
    "compare_results",
    "export_results",
    "inspect_bag",
    "load_config",
    "load_results",
    "rank_sites",
    "replay",
    "scans",
    "steps",
    "suggest_config",
]
