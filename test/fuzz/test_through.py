# SPDX-License-Identifier: Apache-2.0
"""No input breaks what works with it: each case is handled, or rejected and counted by reason.

The slow test sends other cases, by default 4,000 of each kind; ``FUZZ_CASES`` sets their number.
"""

from __future__ import annotations

import os

import pytest
from fuzz.through import INPUTS, attack

CASES, MORE_CASES = 200, int(os.environ.get("FUZZ_CASES", "4000"))


@pytest.mark.parametrize("kind", INPUTS)
def test_no_input_breaks_what_works_with_it(kind):
    told = attack(kind, 1, CASES)
    assert len(told) > 1, "some are taken and some refused"


@pytest.mark.slow
@pytest.mark.parametrize("kind", INPUTS)
def test_many_more_break_nothing(kind):
    attack(kind, 2, MORE_CASES)
