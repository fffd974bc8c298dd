# SPDX-License-Identifier: Apache-2.0
"""Whatever the parameters within their ranges: computed in bounded time, or refused with why."""

from __future__ import annotations

import math
import os
import subprocess
import sys

import numpy as np
import pytest

from quadtree_lss.onboard.config.limits import pass_seconds, why_too_much
from quadtree_lss.onboard.config.settings import (
    Config,
    ConfigError,
    Parameter,
    config_from_values,
    parameters,
)
from quadtree_lss.onboard.core.landing.sites import LandingSiteSelector
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.messages.maps import round_trip

ROWS = parameters()
LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])


def drawn(row: Parameter, rng: np.random.Generator) -> object:
    """A value within the range: an end, the default, or anything of any size between."""
    if row.type is bool:
        return bool(rng.integers(2))
    if row.type is str:
        return str(rng.choice(row.choices)) if row.choices else row.default
    low = max(row.low, 1e-4)
    size = math.exp(rng.uniform(math.log(low), math.log(max(row.high, low))))
    value = (row.low, row.high, row.default, rng.uniform(row.low, row.high), size)[rng.integers(5)]
    return row.type(min(max(value, row.low), row.high))


def some_values(rng: np.random.Generator) -> dict[str, object]:
    """Values of a few parameters, or of many; levels in their order, or most would be refused."""
    number = rng.integers(1, 8) if rng.random() < 0.5 else rng.integers(1, len(ROWS))
    values = {ROWS[k].name: drawn(ROWS[k], rng) for k in rng.choice(len(ROWS), number, False)}
    values["domain.min_level"] = int(rng.integers(0, 5))
    values.pop("mount.gimbal", None)
    return values


def flown(config: Config, rng: np.random.Generator) -> None:
    """Two scans of rough ground, the map's message, and a landing site pass."""
    domain, mapper = config.domain, Mapper(config)
    middle = np.array([domain.xmin, domain.ymin, 0.0]) + 0.5 * domain.size
    middle[2] = min(max(100.0, domain.size), 1e5)
    for k in range(2):
        ground = np.append(1.1 * domain.size * rng.random((1600, 2)), np.zeros((1600, 1)), axis=1)
        ground[:, :2] += domain.xmin, domain.ymin
        ground[:, 2] = 0.05 * ground[:, 0] + rng.normal(0.0, 0.06, 1600)
        pose = Pose(k * 10**9, middle, LOOKING_DOWN, 1e-4 * np.eye(6))
        mapper.update(((ground - middle) @ LOOKING_DOWN).reshape(40, 40, 3), pose)
    LandingSiteSelector(config).assess(round_trip(mapper.snapshot()))


def try_values(seed: int) -> bool:
    """Whether the values of a seed were computed."""
    rng = np.random.default_rng(seed)
    try:
        config = config_from_values(some_values(rng))
    except ConfigError as error:
        assert str(error).isprintable() and len(str(error)) > 20
        return False
    domain = config.domain
    expected = pass_seconds(domain.size, 1 << domain.max_level, config.lss)
    grid = domain.size / config.lss.spacing
    if expected > 1.0 or domain.max_level > 9 or grid > 1000.0:
        return False  # allowed, but too long for a test of many
    flown(config, rng)
    return True


def test_parameters_within_their_ranges_are_computed_or_refused():
    assert sum(try_values(seed) for seed in range(150)) > 40


@pytest.mark.slow
def test_so_are_many_more():
    assert sum(try_values(seed) for seed in range(1000, 5000)) > 1000


#: Each of these took minutes once.
SLOW_ONCE = (
    {"lss.margin": 1000.0},
    {"vehicle.diameter": 1000.0},
    {"vehicle.diameter": 1000.0, "lss.assessment": "paper"},
    {"lss.max_gap": 1000.0, "lss.hazard_growth": 100.0, "lss.margin": 59.0},
    {"lss.sites": 1000, "lss.min_separation": 0.0, "lss.margin": 40.0},
)


def test_what_took_minutes_comes_to_an_end():
    """All of them, in a program that is waited for; they take a few seconds."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    subprocess.run([sys.executable, __file__], env=environment, check=True, timeout=120.0)


def test_a_zone_wider_than_the_domain_costs_no_more_than_one_that_fills_it():
    lss = Config().lss
    wide, wider = (config_from_values({"lss.margin": m}).lss for m in (100.0, 1000.0))
    assert pass_seconds(120.0, 256, lss) < pass_seconds(120.0, 256, wide)
    assert pass_seconds(120.0, 256, wide) == pass_seconds(120.0, 256, wider)


@pytest.mark.parametrize(
    ("size", "finest", "word"),
    [(12_000.0, 4096, "grid_spacing"), (1000.0, 4096, "GB"), (60.0, 2048, "vehicle.diameter")],
)
def test_the_reason_names_what_is_too_much(size, finest, word):
    assert word in why_too_much(size, finest, Config().lss)
    assert why_too_much(120.0, 256, Config().lss) is None


if __name__ == "__main__":
    for values in SLOW_ONCE:
        flown(config_from_values(values), np.random.default_rng(3))
