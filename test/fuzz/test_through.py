# SPDX-License-Identifier: Apache-2.0
"""No input breaks what works with it: each case is taken soundly, or refused by its reason.

More than 7,000 in each run of the tests; more than a million, in pieces of 20,000, with the slow
ones. A piece that was done with these very sources is not done again: whoever breaks off goes on.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import pytest
from core import builders, scenes
from fuzz.through import INPUTS, attack
from messages import samples

import quadtree_lss.onboard

QUICK, PIECE = 400, 20_000


@cache
def sources() -> str:
    """Of what is attacked and of what attacks."""
    whole = hashlib.sha256()
    folders = (Path(quadtree_lss.onboard.__file__).parent, Path(__file__).parent)
    paths = [path for folder in folders for path in sorted(folder.rglob("*.py"))]
    for path in (*paths, *(Path(module.__file__) for module in (builders, scenes, samples))):
        whole.update(path.read_bytes())
    return whole.hexdigest()[:12]


@pytest.mark.parametrize("kind", INPUTS)
def test_no_input_breaks_what_works_with_it(kind):
    told = attack(kind, 1, QUICK)
    assert len(told) > 1, "some are taken and some refused"


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2, 7))
@pytest.mark.parametrize("kind", INPUTS)
def test_none_of_a_million_breaks_it(kind, seed, request, record_property):
    done = f"fuzz/{sources()}/{kind}-{seed}"
    if told := request.config.cache.get(done, None):
        pytest.skip(f"done before: {told}")
    told = attack(kind, seed, PIECE)
    record_property("told", dict(told))
    request.config.cache.set(done, dict(told))
