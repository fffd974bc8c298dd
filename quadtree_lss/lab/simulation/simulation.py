# SPDX-License-Identifier: Apache-2.0
"""Flights over one ground: their messages in the order of arrival, and the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from quadtree_lss.lab.simulation.lidar import StereoCamera
from quadtree_lss.lab.simulation.recording import (
    CAMERA_TOPIC,
    DEPTH_TOPIC,
    POSE_TOPIC,
    SCAN_TOPIC,
    Messages,
)
from quadtree_lss.lab.simulation.safety import LandingGear, safety_map
from quadtree_lss.lab.simulation.scenarios import SCENARIOS, Conditions, FlightPlan
from quadtree_lss.lab.simulation.terrain import SimulationError

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

    def __init__(self, scenario: str, seed: int, *, flights: int = 1, **conditions: Any) -> None:
        if flights < 1:
            raise SimulationError(f"flights must be at least 1, not {flights}")
        if seed < 0:
            raise SimulationError(f"seed must not be negative, not {seed}")
        self.scenario, self.seed, self.stopped = scenario, seed, False
        seeds = np.random.SeedSequence(seed).spawn(3)
        terrain, self._navigation, self._noise = map(np.random.default_rng, seeds)
        self.make = Messages()
        self.legs: list[Leg] = []
        start_ns = _START_NS
        if scenario not in SCENARIOS:
            msg = f"unknown scenario {scenario!r}; there are {', '.join(sorted(SCENARIOS))}"
            raise SimulationError(msg)
        flight, given = SCENARIOS[scenario], Conditions(**conditions)
        seconds = flight.duration if given.duration is None else float(given.duration)
        ground = given.ground(scenario, terrain)
        for number in range(flights):
            plan = flight.plan(given, ground, seconds, number)
            self.legs.append(Leg(plan, start_ns))
            start_ns += round((plan.pose_times[-1] + _GAP_S) * 1e9)

    @property
    def scans(self) -> int:
        return sum(len(leg.scan_ns) for leg in self.legs)

    @property
    def poses(self) -> int:
        return sum(len(leg.pose_ns) for leg in self.legs)

    @property
    def span_ns(self) -> tuple[int, int]:
        """Times of the first and the last arrival, ns."""
        return self.legs[0].arrivals[0][0], self.legs[-1].arrivals[-1][0]

    @property
    def box(self) -> tuple[float, float, float, float]:
        """The scanned area: xmin, xmax, ymin, ymax, m."""
        return self.legs[0].plan.box

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
                    yield POSE_TOPIC, received_ns, pose
                    continue
                view = leg.positions[k], leg.rotations[k]
                scan = plan.lidar.scan(plan.terrain, *view, self._noise)
                leg.scans += 1
                leg.points += int(np.isfinite(scan[..., 0]).sum())
                stamp, camera = int(leg.scan_ns[k]), plan.lidar
                if not isinstance(camera, StereoCamera):
                    yield SCAN_TOPIC, received_ns, self.make.scan(stamp, scan)
                    continue
                size = camera.rows, camera.columns
                yield CAMERA_TOPIC, received_ns, self.make.camera(stamp, *size, camera.focal_length)
                yield DEPTH_TOPIC, received_ns, self.make.depth(stamp, scan[..., 2])

    def truth(self, lander: LandingGear | None = None) -> dict[str, NDArray[Any]]:
        """Content of ``truth.npz`` for the part of the flights that has been simulated."""
        lander = lander or SCENARIOS[self.scenario].lander
        flown = [leg for leg in self.legs if leg.scans]
        xmin, xmax, ymin, ymax = self.box
        step = self.legs[0].plan.spacing
        safe_x = xmin + step * np.arange(round((xmax - xmin) / step) + 1)
        safe_y = ymin + step * np.arange(round((ymax - ymin) / step) + 1)
        dem = self.legs[0].plan.terrain

        def scanned(name: str) -> NDArray[Any]:
            return np.concatenate([getattr(leg, name)[: leg.scans] for leg in flown])

        return {
            "x": dem.x,
            "y": dem.y,
            "elevation": dem.elevation,
            "safe_x": safe_x,
            "safe_y": safe_y,
            "safe": safety_map(dem, safe_x, safe_y, lander),
            "box": np.array(self.box),
            "lander": np.array(lander.limits),
            "scan_stamp_ns": scanned("scan_ns"),
            "scan_position": scanned("positions"),
            "scan_quaternion_xyzw": Rotation.from_matrix(scanned("rotations")).as_quat(),
            "seed": np.array(self.seed),
        }
