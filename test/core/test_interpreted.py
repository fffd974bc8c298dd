# SPDX-License-Identifier: Apache-2.0
"""The sources of the core, run as they are for a debugger, give what the compiled core gives."""

import dataclasses
import os
import pickle
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from core.builders import BY_RISK, by, configured
from core.scenes import make_pose, pose_covariance, scan, scattered

from quadtree_lss import build
from quadtree_lss.lab.evaluation.consistency import prefit_statistics
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.sites import LandingSiteSelector
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.register import register
from quadtree_lss.onboard.core.sensing.sweep import Sweep

SIDE, POINTS = 8.0, 600
VEHICLE = {"diameter": 1.5, "outlier_gate": 1.0}
LIMITS = {"grid_spacing": 0.5, "max_gap": 1.0}
"""Of a few cells: a loop takes a hundred times as long when it is not compiled."""
CONFIGS = {
    "shipped": {"levels": (1, 4), "lss": {**LIMITS, **BY_RISK, "max_risk": 0.5}},
    "paper": {
        "levels": (1, 2),
        "mapping": {"paper": "all"},
        "lss": {**LIMITS, "assessment": "paper", "ranking": "score"},
    },
    "touchdown": {
        "levels": (1, 3),
        "lidar": {"range_noise_per_metre": 1e-4},
        "lss": {**LIMITS, "assessment": "touchdown", "ranking": "score"},
    },
}


def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A gentle slope with a rock and a step."""
    rock = 0.6 * np.exp(-((x - 5.2) ** 2 + (y - 2.7) ** 2) / 0.18)
    return 0.05 * x + rock + 0.4 * (y > 6.6)


def flight(config: Config, organised: bool) -> dict[str, Any]:
    """What becomes of two scans, one stray return in each, and of the landing passes on them."""
    rng = np.random.default_rng(3)
    mapper, selector = Mapper(config), LandingSiteSelector(config)
    covariance = pose_covariance(0.02, 1e-5)
    out: dict[str, Any] = {}
    for k in range(2):
        pose = make_pose((4.0, 4.0, 300.0), covariance, stamp_ns=1 + 500_000_000 * k)
        points = scan(ground, *scattered(rng, 0.0, 0.0, SIDE, POINTS), pose, 0.02, rng)
        points[17] *= 0.9
        turn = pose.rotation_map_lidar.ravel()
        motion = np.array([[*turn, 0.0, 0.0, 0.0], [*turn, 0.01, 0.0, 0.0]])
        sweep = Sweep(np.arange(POINTS, dtype=np.int32), np.array([0.0, POINTS]), motion)
        if k:
            seen, _ = register(points, pose, config.lidar, config.domain)
            out[f"prefit {k}"] = prefit_statistics(mapper.snapshot(), seen, config.lidar)
        shape = (24, 25, 3) if organised else (POINTS, 3)
        out[f"scan {k}"] = mapper.update(points.reshape(shape), pose, None if organised else sweep)
        cells = mapper.snapshot()
        out[f"map {k}"], out[f"landing {k}"] = cells, selector.assess(cells)
    return out


def flights() -> dict[str, Any]:
    """Those of all configurations, as plain data, and whether the core was interpreted."""
    out: dict[str, Any] = {"interpreted": build.interpreted()}
    for name, of in CONFIGS.items():
        rocks = {"ROCK_EXCEPTIONS": np.inf, "ROCK_HEIGHT": 2.0} if name == "touchdown" else {}
        with by(**rocks):
            config = configured(noise=0.02, domain={"size": SIDE}, vehicle=VEHICLE, **of)
            found = flight(config, organised=name != "paper")
        for key, value in found.items():
            out[f"{name} {key}"] = dataclasses.asdict(value)
            out[f"{name} {key}"].pop("ground", None)  # an object of what is compared
    return out


def leaves_of(tree: Any, name: str = "") -> dict[str, Any]:
    """What nested mappings hold in the end, by the path to it."""
    if not isinstance(tree, Mapping):
        return {name: tree}
    found = [leaves_of(value, f"{name}/{key}") for key, value in tree.items()]
    return {key: value for part in found for key, value in part.items()}


def test_the_interpreted_core_maps_and_judges_to_the_same_bits(tmp_path: Path) -> None:
    path = tmp_path / "interpreted"
    environment = {
        **os.environ,
        "QUADTREE_LSS_INTERPRETED": "1",
        "PYTHONPATH": os.pathsep.join(
            [str(Path(__file__).parents[1]), str(Path(build.__file__).parents[1])]
        ),
    }
    command = [sys.executable, "-W", "error", __file__, str(path)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    compiled, interpreted = leaves_of(flights()), leaves_of(pickle.loads(path.read_bytes()))
    assert interpreted.pop("/interpreted") and not compiled.pop("/interpreted")
    assert interpreted.keys() == compiled.keys()
    for name, value in compiled.items():
        np.testing.assert_array_equal(interpreted[name], value, err_msg=name)
    # The scene is not dull: cells are divided, a feature and exceptions found, sites ranked.
    assert compiled["/shipped scan 0/divisions"] > 10
    assert np.isfinite(compiled["/paper map 1/feature"]).any()
    assert compiled["/touchdown map 1/exception_fraction"].max() > 0.0
    for name in ("shipped", "paper", "touchdown"):
        assert len(compiled[f"/{name} landing 1/sites/score"])


if __name__ == "__main__":
    Path(sys.argv[1]).write_bytes(pickle.dumps(flights()))
