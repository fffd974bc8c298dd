# SPDX-License-Identifier: Apache-2.0
"""Scoring of results against simulated truth."""

from quadtree_lss.evaluation.compare import ComparisonResult, compare
from quadtree_lss.evaluation.evaluate import EvaluationResult, evaluate
from quadtree_lss.evaluation.results import EvaluationError

__all__ = [
    "ComparisonResult",
    "EvaluationError",
    "EvaluationResult",
    "compare",
    "evaluate",
]
