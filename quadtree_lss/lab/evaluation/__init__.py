# SPDX-License-Identifier: Apache-2.0
"""Scoring of results against simulated truth."""

from quadtree_lss.lab.evaluation.evaluate import (
    ComparisonResult,
    EvaluationResult,
    compare,
    evaluate,
)
from quadtree_lss.lab.evaluation.results import EvaluationError

__all__ = ["ComparisonResult", "EvaluationError", "EvaluationResult", "compare", "evaluate"]
