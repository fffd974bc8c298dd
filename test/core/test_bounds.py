# SPDX-License-Identifier: Apache-2.0
"""Whatever the parameters within their ranges: computed in bounded time, or refused with why."""

import os
import subprocess
import sys

import numpy as np
import pytest

from quadtree_lss.onboard.config.limits import exceeded_limit
from quadtree_lss.onboard.config.settings import Config, config_from_values
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.messages.maps import round_trip

LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])


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


#: Each of these took minutes once.
SLOW_ONCE = (
    {"lss.margin": 1000.0},
    {"vehicle.diameter": 1000.0},
    {"vehicle.diameter": 1000.0, "lss.assessment": "paper"},
    {"lss.max_gap": 1000.0, "lss.margin": 59.0},
    {"lss.sites": 1000, "lss.margin": 40.0},
)


def test_expensive_configurations_terminate():
    """Run all of them in a subprocess; they take a few seconds."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    subprocess.run([sys.executable, __file__], env=environment, check=True, timeout=120.0)


@pytest.mark.parametrize(
    ("size", "finest", "word"),
    [(12_000.0, 4096, "grid_spacing"), (1000.0, 4096, "GB"), (60.0, 2048, "vehicle.diameter")],
)
def test_exceeded_limit_is_named(size, finest, word):
    assert word in exceeded_limit(size, finest, Config().lss)
    assert exceeded_limit(120.0, 256, Config().lss) is None


if __name__ == "__main__":
    for values in SLOW_ONCE:
        flown(config_from_values(values), np.random.default_rng(3))
