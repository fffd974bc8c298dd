# SPDX-License-Identifier: Apache-2.0
"""Simulate flights over one ground: as a stream of messages, or into a bag and a truth file."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from quadtree_lss.lab.simulation import recording
from quadtree_lss.lab.simulation.lidar import StereoCamera
from quadtree_lss.lab.simulation.safety import LandingGear, safety_map
from quadtree_lss.lab.simulation.scenarios import SCENARIOS, Conditions, FlightPlan
from quadtree_lss.lab.simulation.terrain import SimulationError

TRUTH_NAME = "truth.npz"
_START_NS = 1_700_000_000 * 10**9
_GAP_S = 10.0
_SCAN_LATENCY_NS = 12_000_000
_POSE_LATENCY_NS = 3_000_000


@dataclass
class Leg:
    """One flight over the ground: its schedule and its progress."""

    plan: FlightPlan
    start_ns: int
    scans: int = 0
    poses: int = 0
    points: int = 0

    def __post_init__(self) -> None:
        self.scan_ns = self.start_ns + np.rint(self.plan.scan_times * 1e9).astype(np.int64)
        self.pose_ns = self.start_ns + np.rint(self.plan.pose_times * 1e9).astype(np.int64)
        arrivals = [(int(t) + _POSE_LATENCY_NS, 0, k) for k, t in enumerate(self.pose_ns)]
        arrivals += [(int(t) + _SCAN_LATENCY_NS, 1, k) for k, t in enumerate(self.scan_ns)]
        self.arrivals = sorted(arrivals)
        self.positions, self.rotations = self.plan.trajectory.poses(self.plan.scan_times)


class Simulation:
    """A scenario as a reproducible stream of messages; arguments as in `simulate`. ``stopped`` is
    True if `messages` ended early. Raises `SimulationError`: invalid options."""

    def __init__(self, scenario: str, seed: int, **conditions: Any) -> None:
        if seed < 0:
            raise SimulationError(f"seed must not be negative, not {seed}")
        if scenario not in SCENARIOS:
            msg = f"unknown scenario {scenario!r}; there are {', '.join(sorted(SCENARIOS))}"
            raise SimulationError(msg)
        self.seed, self.stopped = seed, False
        seeds = np.random.SeedSequence(seed).spawn(3)
        terrain, self._navigation, self._noise = map(np.random.default_rng, seeds)
        self.make = recording.Messages()
        flight, given = SCENARIOS[scenario], Conditions(**conditions)
        self._lander = flight.lander
        seconds = flight.duration if given.duration is None else float(given.duration)
        ground = given.ground(scenario, terrain)
        self.legs: list[Leg] = []
        start_ns = _START_NS
        for number in range(given.flights):
            plan = flight.plan(given, ground, seconds, number)
            self.legs.append(Leg(plan, start_ns))
            start_ns += round((plan.pose_times[-1] + _GAP_S) * 1e9)

    def messages(self, stop: Callable[[], bool] | None = None) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, time of reception, ns, and message until ``stop`` returns True."""
        for leg in self.legs:
            plan = leg.plan
            poses = plan.trajectory.poses(plan.pose_times)
            estimate = plan.navigation.estimate(self._navigation, plan.pose_times, *poses)
            rotations = Rotation.from_matrix(estimate.rotations).as_quat()
            for received_ns, kind, k in leg.arrivals:
                if stop is not None and stop():
                    self.stopped = True
                    return
                if kind == 0:
                    leg.poses += 1
                    place, stamp = estimate.positions[k], int(leg.pose_ns[k])
                    pose = self.make.pose(stamp, place, rotations[k], estimate.covariance)
                    yield recording.POSE_TOPIC, received_ns, pose
                    continue
                view = leg.positions[k], leg.rotations[k]
                scan = plan.lidar.scan(plan.terrain, *view, self._noise)
                leg.scans += 1
                leg.points += int(np.isfinite(scan[..., 0]).sum())
                stamp, camera = int(leg.scan_ns[k]), plan.lidar
                if not isinstance(camera, StereoCamera):
                    yield recording.SCAN_TOPIC, received_ns, self.make.scan(stamp, scan)
                    continue
                info = self.make.camera(stamp, camera.rows, camera.columns, camera.focal_length)
                yield recording.CAMERA_TOPIC, received_ns, info
                yield recording.DEPTH_TOPIC, received_ns, self.make.depth(stamp, scan[..., 2])

    def truth(self, lander: LandingGear | None = None) -> dict[str, NDArray[Any]]:
        """Content of ``truth.npz`` for the part of the flights that has been simulated."""
        lander = lander or self._lander
        flown = [leg for leg in self.legs if leg.scans]
        plan = self.legs[0].plan
        xmin, xmax, ymin, ymax = plan.box
        safe_x = xmin + plan.spacing * np.arange(round((xmax - xmin) / plan.spacing) + 1)
        safe_y = ymin + plan.spacing * np.arange(round((ymax - ymin) / plan.spacing) + 1)

        def scanned(name: str) -> NDArray[Any]:
            return np.concatenate([getattr(leg, name)[: leg.scans] for leg in flown])

        return {
            "x": plan.terrain.x,
            "y": plan.terrain.y,
            "elevation": plan.terrain.elevation,
            "safe_x": safe_x,
            "safe_y": safe_y,
            "safe": safety_map(plan.terrain, safe_x, safe_y, lander),
            "box": np.array(plan.box),
            "lander": np.array(lander.limits),
            "scan_stamp_ns": scanned("scan_ns"),
            "scan_position": scanned("positions"),
            "scan_quaternion_xyzw": Rotation.from_matrix(scanned("rotations")).as_quat(),
            "seed": np.array(self.seed),
        }


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
        lander: Vehicle of the true safety, by default that of the scenario.
        progress: Called with the numbers of done and of all scans after each scan.
        stop: Called after each message; True ends the flight there.
        conditions: Fields of `Conditions`.

    Raises:
        SimulationError: the options are invalid, or a file exists and ``overwrite`` is False.
        KeyboardInterrupt: stopped before the first scan.
    """
    path = Path(bag_path)
    simulation = Simulation(scenario, seed, **conditions)
    truth_path = path.parent / TRUTH_NAME
    existing = [str(there) for there in (path, truth_path) if there.exists()]
    if existing and not overwrite:
        msg = f"{existing[0]} exists; choose another folder, or --overwrite to replace it"
        raise SimulationError(msg)
    if path.exists() and not (path / "metadata.yaml").is_file():
        raise SimulationError(f"{path} is not a bag; it is not overwritten")
    legs = simulation.legs
    total = sum(len(leg.scan_ns) for leg in legs)
    try:
        if path.exists():
            shutil.rmtree(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        with recording.recorded(path) as write:
            for topic, received_ns, message in simulation.messages(stop):
                write(topic, received_ns, message)
                if progress is not None and topic in (recording.SCAN_TOPIC, recording.DEPTH_TOPIC):
                    progress(sum(leg.scans for leg in legs), total)
        if not legs[0].scans:
            raise KeyboardInterrupt
        arrays = simulation.truth(lander)
        np.savez_compressed(truth_path, **arrays)  # type: ignore[arg-type]
    except BaseException as error:
        # Remove an incomplete bag, which looks like a complete one.
        shutil.rmtree(path, ignore_errors=True)
        if isinstance(error, OSError):
            raise SimulationError(f"cannot write {path}: {error.strerror or error}") from error
        raise
    return SimulationResult(
        scenario=scenario,
        seed=seed,
        bag_path=path,
        truth_path=truth_path,
        scans=sum(leg.scans for leg in legs),
        poses=sum(leg.poses for leg in legs),
        points=sum(leg.points for leg in legs),
        duration=sum(float(leg.plan.scan_times[leg.scans - 1]) for leg in legs if leg.scans),
        box=legs[0].plan.box,
        safe_fraction=float(arrays["safe"].mean()),
        interrupted=simulation.stopped,
    )
