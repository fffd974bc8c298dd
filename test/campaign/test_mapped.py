# SPDX-License-Identifier: Apache-2.0
"""What a campaign keeps of the risks that maps predicted."""

import numpy as np
import pytest

from quadtree_lss.lab.campaign.mapped import risks
from quadtree_lss.lab.evaluation.metrics import reliability


def test_told_and_failed_are_counted_by_predicted_risk():
    rng = np.random.default_rng(1)
    risk = rng.random(20_000) ** 3
    failed = rng.random(20_000) < risk
    found = risks(reliability(risk, failed))
    for name, low, high in (("0.1", 0.001, 0.003), ("1", 0.01, 0.03), ("10", 0.1, 0.3)):
        here = (risk >= low) & (risk < high)
        assert found[f"risk_{name}_points"] == here.sum()
        assert found[f"risk_{name}_unsafe"] == failed[here].sum()
        assert found[f"risk_{name}_expected"] == pytest.approx(risk[here].sum())
    assert found["brier"] == pytest.approx(np.square(risk - failed).mean())


def test_a_map_without_risks_has_none():
    found = risks(None)
    assert found["brier"] is None and found["risk_10_points"] == 0
