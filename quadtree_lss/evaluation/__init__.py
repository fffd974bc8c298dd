# SPDX-License-Identifier: Apache-2.0
"""Scoring of results against simulated truth."""

from quadtree_lss.evaluation.compare import ComparisonResult, compare
from quadtree_lss.evaluation.evaluate import EvaluationResult, evaluate
from quadtree_lss.evaluation.results import EvaluationError
from quadtree_lss.evaluation.safety import Lander, contact_safe, safety_map

__all__ = [
    "ComparisonResult",
    "EvaluationError",
    "EvaluationResult",
    "Lander",
    "compare",
    "contact_safe",
    "evaluate",
    "safety_map",
]
