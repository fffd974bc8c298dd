# SPDX-License-Identifier: Apache-2.0
"""Fly a scenario: write the bag and, beside it, the truth."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from quadtree_lss.simulation.recording import BagRecorder
from quadtree_lss.simulation.safety import Lander, safety_map
from quadtree_lss.simulation.scenarios import (
    GRID_SPACING,
    SCENARIOS,
    Flight,
    make_request,
    quaternions,
)
from quadtree_lss.simulation.terrain import FloatArray, SimulationError, Terrain

TRUTH_NAME = "truth.npz"
_START_NS = 1_700_000_000 * 10**9
_FLIGHT_GAP_S = 10.0
_SCAN_LATENCY_NS = 12_000_000
_POSE_LATENCY_NS = 3_000_000


@dataclass(frozen=True)
class SimulationResult:
    """What was written.

    ``starts`` are the seconds after the bag's first message at which each flight is sure to be
    still to come (the first: 0), as ``replay --start`` takes them. ``interrupted`` says that it was
    stopped before the end of what was to be flown.
    """

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
    starts: tuple[float, ...] = (0.0,)
    interrupted: bool = False

    def as_dict(self) -> dict[str, Any]:
        """Ready for JSON."""
        return {k: str(v) if isinstance(v, Path) else v for k, v in asdict(self).items()}

    def table(self) -> str:
        """A few aligned lines for people."""
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
        ends = (*self.starts[1:], None)
        for k, (start, end) in enumerate(zip(self.starts, ends, strict=True), start=1):
            if len(self.starts) > 1:
                options = [f"--start {start:.1f}"] if start else []
                options += [f"--duration {end - start:.1f}"] if end is not None else []
                rows.append((f"Flight {k} alone", f"replay {' '.join(options)}"))
        width = max(len(label) for label, _ in rows)
        return "\n".join(f"{label:<{width}}  {value}" for label, value in rows)


def simulate(
    scenario: str,
    bag_path: str | Path,
    *,
    seed: int,
    duration: float | None = None,
    terrain: Terrain | str | Path | None = None,
    range_noise: float | None = None,
    outliers: float = 0.0,
    dropouts: float = 0.0,
    flights: int = 1,
    truth: bool = True,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> SimulationResult:
    """Simulate ``scenario`` (morpheus, parabola or descent) into a ROS 2 bag.

    Topics: ``/lidar/points`` (organised 128×128 cloud in frame ``lidar``) and ``/nav/pose`` (the
    lidar's estimated pose in frame ``map``, with covariance). ``truth.npz`` goes into the bag's
    parent directory; one of another bag that is there is replaced with ``overwrite`` only, as is a
    bag. Its ``bag_name`` and ``seed`` tell which flight it is of. ``terrain`` is a DEM or the path
    of one; ``flights`` > 1 flies again over the same ground with new navigation errors, into the
    same bag. ``progress(done, total)`` is called after every scan. The same arguments give the same
    messages.
    ``stop`` is asked before every message; once it answers True, bag and truth are of what was
    flown so far.

    Raises `SimulationError` for options that make no sense and for what would be overwritten,
    KeyboardInterrupt if it is stopped before the first scan.
    """
    path = Path(bag_path)
    if flights < 1:
        msg = f"flights must be at least 1, not {flights}"
        raise SimulationError(msg)
    if seed < 0:
        msg = f"seed must not be negative, not {seed}"
        raise SimulationError(msg)
    field_seed, navigation_seed, lidar_seed = np.random.SeedSequence(seed).spawn(3)
    request = make_request(
        scenario,
        np.random.default_rng(field_seed),
        duration=duration,
        terrain=terrain,
        range_noise=range_noise,
        outliers=outliers,
        dropouts=dropouts,
    )
    plans = [SCENARIOS[scenario].plan(request, flight) for flight in range(flights)]
    safe_fraction, truth_path = None, path.parent / TRUTH_NAME if truth else None
    if truth_path is not None and not overwrite:
        _spare_truth(truth_path, path.name)
    _make_room(path, overwrite)
    navigation, noise = np.random.default_rng(navigation_seed), np.random.default_rng(lidar_seed)
    total = sum(plan.scan_times.size for plan in plans)
    flown: list[_Flown] = []
    start_ns = _START_NS
    try:
        with BagRecorder(path) as recorder:
            for plan in plans:
                done = sum(leg.stamps_ns.size for leg in flown)
                report = None if progress is None else _offset(progress, done, total)
                flown.append(_fly(plan, start_ns, recorder, navigation, noise, report, stop))
                if flown[-1].stopped:
                    break
                start_ns += round((plan.pose_times[-1] + _FLIGHT_GAP_S) * 1e9)
        if not flown[0].stamps_ns.size:
            raise KeyboardInterrupt
        if truth_path is not None:
            safe_fraction = _write_truth(truth_path, plans[0], flown, path.name, seed)
    except BaseException as error:
        # Half a bag looks like a whole one.
        shutil.rmtree(path, ignore_errors=True)
        if isinstance(error, OSError):
            msg = f"cannot write {path}: {error.strerror or error}"
            raise SimulationError(msg) from error
        raise
    return SimulationResult(
        scenario=scenario,
        seed=seed,
        bag_path=path,
        truth_path=truth_path,
        scans=sum(leg.stamps_ns.size for leg in flown),
        poses=sum(leg.poses for leg in flown),
        points=sum(leg.points for leg in flown),
        duration=sum(leg.seconds for leg in flown),
        box=plans[0].box,
        safe_fraction=safe_fraction,
        starts=_starts(flown),
        interrupted=flown[-1].stopped,
    )


@dataclass(frozen=True)
class _Flown:
    stamps_ns: np.ndarray
    positions: FloatArray
    quaternions_xyzw: FloatArray
    outlines: FloatArray
    poses: int
    points: int
    first_ns: int
    last_ns: int
    seconds: float
    stopped: bool


def _starts(flown: list[_Flown]) -> tuple[float, ...]:
    """Tenths of seconds in the middle of the gaps before the flights."""
    first = flown[0].first_ns
    middles = [
        (0.5 * (before.last_ns - first) + 0.5 * (leg.first_ns - first)) * 1e-9
        for before, leg in zip(flown[:-1], flown[1:], strict=True)
    ]
    return (0.0, *(round(middle, 1) for middle in middles))


def _offset(progress: Callable[[int, int], None], done: int, total: int) -> Callable[[int], None]:
    return lambda scans: progress(done + scans, total)


def _spare_truth(path: Path, bag_name: str) -> None:
    """Refuse to replace the truth of another bag: its results would be scored against this one."""
    if not path.exists():
        return
    try:
        with np.load(path, allow_pickle=False) as arrays:
            owner = str(arrays["bag_name"])
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile):
        owner = ""
    if owner != bag_name:
        whose = f"of the bag '{owner}'" if owner else "of a bag it does not name"
        msg = f"{path} is {whose}; choose another folder, or --overwrite to replace it"
        raise SimulationError(msg)


def _make_room(path: Path, overwrite: bool) -> None:
    """Make the parent directory; remove an old bag only when asked to."""
    if path.exists():
        if not overwrite:
            msg = f"{path} exists; choose another path, or --overwrite to replace it"
            raise SimulationError(msg)
        if not path.is_dir():
            msg = f"{path} is a file, and bags are directories; it is not overwritten"
            raise SimulationError(msg)
        if not (path / "metadata.yaml").is_file() and any(path.iterdir()):
            msg = f"{path} is a directory but no bag; it is not overwritten"
            raise SimulationError(msg)
        shutil.rmtree(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        msg = f"cannot create {path.parent}: {error.strerror}"
        raise SimulationError(msg) from error


def _fly(
    plan: Flight,
    start_ns: int,
    recorder: BagRecorder,
    navigation: np.random.Generator,
    noise: np.random.Generator,
    report: Callable[[int], None] | None,
    stop: Callable[[], bool] | None,
) -> _Flown:
    """Record one flight in the order in which messages would arrive."""
    scan_ns = start_ns + np.rint(plan.scan_times * 1e9).astype(np.int64)
    pose_ns = start_ns + np.rint(plan.pose_times * 1e9).astype(np.int64)
    positions, rotations = plan.trajectory.poses(plan.scan_times)
    estimate = plan.navigation.estimate(
        navigation, plan.pose_times, *plan.trajectory.poses(plan.pose_times)
    )
    pose_quaternions = quaternions(estimate.rotations)
    arrivals = [(int(t) + _POSE_LATENCY_NS, 0, k) for k, t in enumerate(pose_ns)]
    arrivals += [(int(t) + _SCAN_LATENCY_NS, 1, k) for k, t in enumerate(scan_ns)]
    outlines: list[FloatArray] = []
    points, poses, stopped = 0, 0, False
    for received_ns, kind, k in sorted(arrivals):
        if stop is not None and stop():
            stopped = True
            break
        if kind == 0:
            recorder.pose(
                int(pose_ns[k]),
                estimate.positions[k],
                pose_quaternions[k],
                estimate.covariance,
                received_ns,
            )
            poses += 1
            continue
        scan = plan.lidar.scan(plan.surface, positions[k], rotations[k], noise)
        outlines.append(plan.lidar.outline(plan.surface, positions[k], rotations[k]))
        points += int(np.isfinite(scan[..., 0]).sum())
        recorder.scan(int(scan_ns[k]), scan, received_ns)
        if report is not None:
            report(k + 1)
    scans = len(outlines)
    return _Flown(
        stamps_ns=scan_ns[:scans],
        positions=positions[:scans],
        quaternions_xyzw=quaternions(rotations[:scans]),
        outlines=np.array(outlines),
        poses=poses,
        points=points,
        first_ns=min(arrivals)[0],
        last_ns=max(arrivals)[0],
        seconds=float(plan.scan_times[scans - 1]) if scans else 0.0,
        stopped=stopped,
    )


def _write_truth(path: Path, plan: Flight, flown: list[_Flown], bag_name: str, seed: int) -> float:
    """Write the truth file; returns the fraction of safe grid points."""
    xmin, xmax, ymin, ymax = plan.box
    safe_x = xmin + GRID_SPACING * np.arange(round((xmax - xmin) / GRID_SPACING) + 1)
    safe_y = ymin + GRID_SPACING * np.arange(round((ymax - ymin) / GRID_SPACING) + 1)
    dem = plan.truth
    safe = safety_map(dem.x, dem.y, dem.elevation, safe_x, safe_y, Lander())
    np.savez_compressed(
        path,
        x=dem.x,
        y=dem.y,
        elevation=dem.elevation,
        safe_x=safe_x,
        safe_y=safe_y,
        safe=safe,
        box=np.array(plan.box),
        scan_stamp_ns=np.concatenate([leg.stamps_ns for leg in flown]),
        scan_position=np.concatenate([leg.positions for leg in flown]),
        scan_quaternion_xyzw=np.concatenate([leg.quaternions_xyzw for leg in flown]),
        scan_outline=np.concatenate([leg.outlines for leg in flown]),
        bag_name=np.array(bag_name),
        seed=np.array(seed),
        scan_flight=np.repeat(np.arange(len(flown)), [leg.stamps_ns.size for leg in flown]),
    )
    return float(safe.mean())
