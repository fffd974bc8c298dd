# SPDX-License-Identifier: Apache-2.0
"""What the map claims is what it errs by, however long the same ground is seen."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmark"))

import hover

CASES = [(name, align) for name in hover.KINDS for align in (True, False)]


def ratios(
    kind: str, align: bool, counts: list[int], flights: int, first_seed: int = 950
) -> np.ndarray:
    """Error over claimed deviation, root mean square: (counts, 2) of slopes and heights."""
    maps = [hover.hovering(hover.KINDS[kind], align) for _ in range(flights)]
    found = np.array([hover.hover(one, first_seed + k, counts) for k, one in enumerate(maps)])
    ratio = found[:, :, 0] / found[:, :, 1]
    return np.array([hover.both(ratio[:, at]) for at in range(len(counts))])


@pytest.mark.parametrize(("kind", "align"), CASES)
def test_errors_are_as_claimed(kind, align):
    """Of height and slopes; few flights share few errors, so the bounds are wide."""
    found = ratios(kind, align, [100, 1000], 5)
    assert (found > 0.35).all()
    assert (found < 1.9).all()
