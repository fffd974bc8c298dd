# SPDX-License-Identifier: Apache-2.0
"""Scoring of results against simulated truth."""

from quadtree_lss.evaluation.compare import ComparisonResult, compare
from quadtree_lss.evaluation.evaluate import EvaluationResult, evaluate
from quadtree_lss.evaluation.results import EvaluationError
from quadtree_lss.evaluation.safety import Lander, contact_safe, safety_map
from quadtree_lss.evaluation.seed_summary import SeedsResult
from quadtree_lss.evaluation.seeds import FlightOptions, evaluate_seeds, parse_seeds

__all__ = [
    "ComparisonResult",
    "EvaluationError",
    "EvaluationResult",
    "FlightOptions",
    "Lander",
    "SeedsResult",
    "compare",
    "contact_safe",
    "evaluate",
    "evaluate_seeds",
    "parse_seeds",
    "safety_map",
]
