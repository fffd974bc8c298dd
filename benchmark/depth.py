# SPDX-License-Identifier: Apache-2.0
"""A stereo depth camera on a drone, 15 m to 3 m: what its risk is worth, and what a scan costs.

Flights of ``simulate depth`` with ``config/depth_camera.yaml``. Of the ground that was seen: how
much of what is unsafe is called safe, and how much of what is safe is, by greatest risk. The times
are CPU seconds of the thread, of images with more than a thousand points in the map.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import machine, table

from quadtree_lss.lab.campaign.study import parse_seeds
from quadtree_lss.lab.evaluation.risk_flights import lander_of
from quadtree_lss.lab.simulation.recording import CAMERA_TOPIC, POSE_TOPIC
from quadtree_lss.lab.simulation.simulation import Simulation
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.loading import load_config
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.sites import LandingSiteSelector
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.messages.intake import Intake
from quadtree_lss.onboard.messages.maps import round_trip

PRESET = Path(__file__).parent.parent / "config" / "depth_camera.yaml"
RISKS = (0.002, 0.006, 0.02, 0.05)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="9421-9424", help="first-last")
    parser.add_argument("--duration", type=float, help="of a flight, s")
    options = parser.parse_args()
    print(machine())
    config = load_config([str(PRESET)])
    flown = [fly(seed, options.duration, config) for seed in parse_seeds(options.seeds)]
    risk, safe = (np.concatenate([flight[k] for flight in flown]) for k in (0, 1))
    seen = np.concatenate([flight[2] for flight in flown])
    rows = []
    for most in RISKS:
        called = risk <= most
        wrong, kept = (np.mean(called[seen & part]) for part in (~safe, safe))
        rows.append([f"{most:g}", f"{wrong:.2%}", f"{kept:.1%}"])
    title = f"{len(flown)} flights, seeds {options.seeds}, {np.mean(seen):.0%} of the box seen"
    table(title, ["greatest risk", "unsafe called safe", "safe called safe"], rows)
    rows = []
    for k, name in ((3, "message to points"), (4, "scan update")):
        taken = 1e3 * np.concatenate([flight[k] for flight in flown])
        rows.append([name, *(f"{np.percentile(taken, share):.2f}" for share in (50, 99))])
    table("an image of 640 x 480, every second pixel", ["", "median ms", "99 % ms"], rows)


def fly(seed: int, duration: float | None, config: Config) -> tuple[Array, ...]:
    """Risk, truth and what is seen (N,) of the box; seconds of decoding and of scan updates."""
    simulation = Simulation("depth", seed, duration=duration)
    intake, mapper, taken = Intake(config), Mapper(config), []
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
            if report.points_used > 1000:
                taken.append((decoded, time.thread_time() - began))
    found = LandingSiteSelector(config).assess(round_trip(mapper.snapshot()))
    truth = simulation.truth("bag", lander_of(config))
    rows, columns = (
        np.abs(axis[:, None] - truth[f"safe_{name}"]).argmin(axis=0)
        for axis, name in ((found.y, "y"), (found.x, "x"))
    )
    seen = found.hazard[np.ix_(rows, columns)] & 0x80 == 0
    risk = found.risk[np.ix_(rows, columns)]
    times = np.array(taken).reshape(-1, 2)
    return risk.ravel(), truth["safe"].ravel(), seen.ravel(), times[:, 0], times[:, 1]


if __name__ == "__main__":
    main()
