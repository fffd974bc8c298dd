# SPDX-License-Identifier: Apache-2.0
"""Scoring of results against simulated truth."""

from quadtree_lss.lab.evaluation.compare import ComparisonResult, compare
from quadtree_lss.lab.evaluation.evaluate import EvaluationResult, evaluate
from quadtree_lss.lab.evaluation.results import EvaluationError

__all__ = [
    "ComparisonResult",
    "EvaluationError",
    "EvaluationResult",
    "compare",
    "evaluate",
]
