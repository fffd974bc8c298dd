# SPDX-License-Identifier: Apache-2.0
"""Simulate a scenario into a bag and a truth file."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from quadtree_lss.lab.simulation.recording import DEPTH_TOPIC, SCAN_TOPIC, recorded
from quadtree_lss.lab.simulation.safety import LandingGear
from quadtree_lss.lab.simulation.simulation import Simulation
from quadtree_lss.lab.simulation.terrain import SimulationError

TRUTH_NAME = "truth.npz"


@dataclass(frozen=True)
class SimulationResult:
    """Summary of a simulation; ``interrupted``: the bag ends early."""

    scenario: str
    seed: int
    bag_path: Path
    truth_path: Path
    scans: int
    poses: int
    points: int
    duration: float
    box: tuple[float, float, float, float]
    safe_fraction: float
    interrupted: bool = False

    def as_dict(self) -> dict[str, Any]:
        return {k: str(v) if isinstance(v, Path) else v for k, v in asdict(self).items()}

    def table(self) -> str:
        xmin, xmax, ymin, ymax = self.box
        rows = [
            ("Bag", str(self.bag_path)),
            ("Scans / poses / returns", f"{self.scans} / {self.poses} / {self.points}"),
            ("Seconds of scanning", f"{self.duration:.1f}"),
            ("Scanned box", f"x {xmin:g} … {xmax:g} m, y {ymin:g} … {ymax:g} m"),
            ("Truth", str(self.truth_path)),
            ("Safe part of the box", f"{100.0 * self.safe_fraction:.1f} %"),
        ]
        return "\n".join(f"{label:<24}  {value}" for label, value in rows)


def simulate(
    scenario: str,
    bag_path: str | Path,
    *,
    seed: int,
    flights: int = 1,
    overwrite: bool = False,
    lander: LandingGear | None = None,
    progress: Callable[[int, int], None] | None = None,
    stop: Callable[[], bool] | None = None,
    **conditions: Any,
) -> SimulationResult:
    """Simulate a flight into a ROS 2 bag, with ``truth.npz`` beside it; reproducible by its seed.

    The topics are ``/lidar/points`` (organised cloud in frame ``lidar``; for the scenario ``depth``
    ``/depth/image`` and ``/depth/camera_info``) and ``/nav/pose`` (estimated pose of the lidar in
    frame ``map``, with covariance).

    Args:
        scenario: A key of `SCENARIOS`.
        flights: Number of flights over the same ground, each with new navigation errors.
        lander: Vehicle of the true safety, by default that of the scenario.
        progress: Called with the numbers of done and of all scans after each scan.
        stop: Called after each message; True ends the flight there.
        conditions: Fields of `Conditions`.

    Raises:
        SimulationError: the options are invalid, or a file exists and ``overwrite`` is False.
        KeyboardInterrupt: stopped before the first scan.
    """
    path = Path(bag_path)
    simulation = Simulation(scenario, seed, flights=flights, **conditions)
    truth_path = path.parent / TRUTH_NAME
    if truth_path.exists() and not overwrite:
        msg = f"{truth_path} exists; choose another folder, or --overwrite to replace it"
        raise SimulationError(msg)
    _prepare_path(path, overwrite)
    done = 0
    try:
        with recorded(path) as write:
            for topic, received_ns, message in simulation.messages(stop):
                write(topic, received_ns, message)
                if progress is not None and topic in (SCAN_TOPIC, DEPTH_TOPIC):
                    done += 1
                    progress(done, simulation.scans)
        if not simulation.legs[0].scans:
            raise KeyboardInterrupt
        arrays = simulation.truth(lander)
        np.savez_compressed(truth_path, **arrays)  # type: ignore[arg-type]
    except BaseException as error:
        # Remove an incomplete bag, which looks like a complete one.
        shutil.rmtree(path, ignore_errors=True)
        if isinstance(error, OSError):
            raise SimulationError(f"cannot write {path}: {error.strerror or error}") from error
        raise
    flown = [leg for leg in simulation.legs if leg.poses or leg.scans]
    return SimulationResult(
        scenario=scenario,
        seed=seed,
        bag_path=path,
        truth_path=truth_path,
        scans=sum(leg.scans for leg in flown),
        poses=sum(leg.poses for leg in flown),
        points=sum(leg.points for leg in flown),
        duration=sum(float(leg.plan.scan_times[leg.scans - 1]) for leg in flown if leg.scans),
        box=simulation.box,
        safe_fraction=float(arrays["safe"].mean()),
        interrupted=simulation.stopped,
    )


def _prepare_path(path: Path, overwrite: bool) -> None:
    """Make the parent directory; remove an existing bag if ``overwrite``."""
    if path.exists():
        if not overwrite:
            raise SimulationError(
                f"{path} exists; choose another path, or --overwrite to replace it"
            )
        if not (path / "metadata.yaml").is_file():
            raise SimulationError(f"{path} is not a bag; it is not overwritten")
        shutil.rmtree(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SimulationError(f"cannot create {path.parent}: {error.strerror}") from error
