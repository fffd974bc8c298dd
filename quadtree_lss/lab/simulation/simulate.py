# SPDX-License-Identifier: Apache-2.0
"""Fly a scenario: write the bag and, beside it, the truth."""

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
    """Summary of the bag; ``interrupted``: it ends early."""

    scenario: str
    seed: int
    bag_path: Path
    truth_path: Path | None
    scans: int
    poses: int
    points: int
    duration: float
    box: tuple[float, float, float, float]
    safe_fraction: float | None
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
        ]
        if self.truth_path is not None:
            rows.append(("Truth", str(self.truth_path)))
        if self.safe_fraction is not None:
            rows.append(("Safe part of the box", f"{100.0 * self.safe_fraction:.1f} %"))
        return "\n".join(f"{label:<24}  {value}" for label, value in rows)


def simulate(
    scenario: str,
    bag_path: str | Path,
    *,
    seed: int,
    flights: int = 1,
    truth: bool = True,
    overwrite: bool = False,
    lander: LandingGear | None = None,
    progress: Callable[[int, int], None] | None = None,
    stop: Callable[[], bool] | None = None,
    **conditions: Any,
) -> SimulationResult:
    """Simulate ``scenario`` (see `scenarios`) into a ROS 2 bag, reproducibly.

    Topics: ``/lidar/points`` (organised cloud in frame ``lidar``; ``depth``: ``/depth/image`` and
    ``/depth/camera_info``) and ``/nav/pose`` (estimated pose of the lidar in frame ``map``, with
    covariance). ``truth.npz`` goes beside the bag. ``flights`` > 1 repeats the flight over the same
    ground with new navigation errors. ``lander``: whose safety is in the truth; ``conditions``: see
    `scenarios.Conditions`. ``progress(done, total)`` is called after every scan; the flight ends
    when ``stop`` returns True.

    Raises `SimulationError`: the options are invalid, or a file would be overwritten without
    ``overwrite``; KeyboardInterrupt: stopped before the first scan.
    """
    path = Path(bag_path)
    simulation = Simulation(scenario, seed, flights=flights, **conditions)
    safe_fraction, truth_path = None, path.parent / TRUTH_NAME if truth else None
    if truth_path is not None and truth_path.exists() and not overwrite:
        msg = f"{truth_path} exists; choose another folder, or --overwrite to replace it"
        raise SimulationError(msg)
    _make_room(path, overwrite)
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
        if truth_path is not None:
            arrays = simulation.truth(lander)
            np.savez_compressed(truth_path, **arrays)  # type: ignore[arg-type]
            safe_fraction = float(arrays["safe"].mean())
    except BaseException as error:
        # Half a bag looks like a whole one.
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
        safe_fraction=safe_fraction,
        interrupted=simulation.stopped,
    )


def _make_room(path: Path, overwrite: bool) -> None:
    """Make the parent directory; remove an old bag only when asked to."""
    if path.exists():
        if not overwrite:
            raise SimulationError(
                f"{path} exists; choose another path, or --overwrite to replace it"
            )
        if not (path / "metadata.yaml").is_file():
            raise SimulationError(f"{path} is no bag; it is not overwritten")
        shutil.rmtree(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SimulationError(f"cannot create {path.parent}: {error.strerror}") from error
