# SPDX-License-Identifier: Apache-2.0
"""A stereo depth camera on a drone, 15 m to 3 m: what its risk is worth, and what a scan costs.

Flights of ``simulate depth`` with ``config/depth_camera.yaml``. By greatest risk: how much of what
is unsafe is called safe, and how much of what is safe is, of grid points under whose lander all
ground is seen, as for the drone's lidars, and of all that are seen themselves. The times are CPU
seconds of the thread, of images with more than a thousand points in the map.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import machine, mean_heights, table
from scipy.ndimage import distance_transform_edt

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.lab.campaign.study import parse_seeds
from quadtree_lss.lab.evaluation.risk_flights import lander_of
from quadtree_lss.lab.simulation.recording import CAMERA_TOPIC, POSE_TOPIC
from quadtree_lss.lab.simulation.simulation import Simulation
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.sites import LandingSiteSelector
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.messages.intake import Intake
from quadtree_lss.onboard.messages.maps import round_trip

PRESET = Path(__file__).parent.parent / "config" / "depth_camera.yaml"
RISKS = (0.0005, 0.001, 0.002, 0.006, 0.02)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="9421-9424", help="first-last")
    parser.add_argument("--duration", type=float, help="of a flight, s")
    options = parser.parse_args()
    print(machine())
    config = load_config([str(PRESET)])
    flown = [fly(seed, options.duration, config) for seed in parse_seeds(options.seeds)]
    risk, deep, seen, judged = (np.concatenate([f[0][k] for f in flown]) for k in range(4))
    rows = []
    for most in RISKS:
        shares = [
            f"{np.mean(risk[of & part] <= most):.2%}"
            for of in (judged > 0.0, seen > 0.0)
            for part in (deep > 0.0, deep == 0.0)
        ]
        wrong = deep[(judged > 0.0) & (risk <= most)].max(initial=0.0)
        rows.append([f"{most:g}", *shares, f"{wrong:.2f}"])
    title = f"{len(flown)} flights, seeds {options.seeds}: {np.mean(judged):.0%} of the box judged,"
    header = ["unsafe called safe", "safe called safe"]
    header = ["greatest risk", *header, *(f"{name}, of all seen" for name in header), "deepest, m"]
    table(f"{title} {np.mean(seen):.0%} seen", header, rows)
    taken = 1e3 * np.concatenate([flight[1] for flight in flown])
    names = ("message to points", "scan update", "plain compiled loop of mean heights")
    rows = [
        [name, *(f"{np.percentile(column, share):.2f}" for share in (50, 99))]
        for name, column in zip(names, taken.T, strict=True)
    ]
    table("an image of 640 x 480, every second pixel", ["", "median ms", "99 % ms"], rows)


def fly(seed: int, duration: float | None, config: Config) -> tuple[Array, Array]:
    """(4, N) of the box's grid points: risk, how deep in unsafe ground, m, whether seen, whether
    judged; seconds (T, 3) of decoding, of scan updates and of mean heights of the same points."""
    simulation = Simulation("depth", seed, duration=duration)
    intake, mapper, taken = Intake(config), Mapper(config), []
    floor = next(iter(mean_heights(mapper.domain).values()))
    for topic, received_ns, message in simulation.messages():
        if topic == POSE_TOPIC:
            intake.on_pose(message)
        elif topic == CAMERA_TOPIC:
            intake.on_camera_info(message)
        else:
            began = time.thread_time()
            intake.on_cloud(message, received_ns)
            decoded = time.thread_time() - began
        for scan in intake.ready(received_ns):
            began = time.thread_time()
            report = mapper.update(scan.points_lidar, scan.pose, scan.sweep)
            updated = time.thread_time() - began
            if report.points_used > 1000:
                points = np.asarray(scan.points_lidar, dtype=np.float64)
                began = time.thread_time()
                floor(points, scan.pose)
                taken.append((decoded, updated, time.thread_time() - began))
    found = LandingSiteSelector(config).assess(round_trip(mapper.snapshot()))
    truth = simulation.truth("bag", lander_of(config))
    at = np.ix_(
        *(
            np.abs(axis[:, None] - truth[f"safe_{name}"]).argmin(axis=0)
            for axis, name in ((found.y, "y"), (found.x, "x"))
        )
    )
    step = config.lss.grid_spacing
    seen = found.hazard & 0x80 == 0
    judged = step * distance_transform_edt(seen) > 0.5 * config.vehicle.diameter
    deep = step * distance_transform_edt(~truth["safe"])
    told = [found.risk[at], deep, seen[at], judged[at]]
    return np.stack(told).reshape(4, -1), np.array(taken).reshape(-1, 3)


if __name__ == "__main__":
    main()
