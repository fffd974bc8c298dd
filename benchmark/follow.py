# SPDX-License-Identifier: Apache-2.0
"""A map that follows the drone over a kilometre of fields with rocks, at 25 m height and 6 m/s.

A flash lidar of 128 x 128 beams, 45 degrees wide, scans 21 m of ground at 20 Hz, which gives about
forty returns per leaf. The script prints memory, the delay of map and sites in CPU seconds from the
stamp of a scan (one core for each node), and, at regular intervals, the true safety of the place
that ``~/land_now`` would select. The ground is 105 m wide and continued by reflection; the path
crosses it diagonally, so that no place is passed twice.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import configuration, machine, table

from quadtree_lss.lab.campaign.study import parse_seeds
from quadtree_lss.lab.evaluation.risk_flights import lander_of
from quadtree_lss.lab.simulation.hazard_field import HazardField, hazard_field
from quadtree_lss.lab.simulation.lidar import FlashLidar
from quadtree_lss.lab.simulation.navigation import DriftingNavigation
from quadtree_lss.lab.simulation.safety import contact_safe
from quadtree_lss.lab.simulation.terrain import Terrain
from quadtree_lss.lab.simulation.trajectory import NORTH, look_at
from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.messages.maps import decode_cells, encode_cells, round_trip

HEIGHT, SPEED, RATE, FIELD_OF_VIEW = 25.0, 6.0, 20.0, 45.0
SCALE, SIDE, PART_LENGTH = 0.35, 300.0, 30.0
#: Radius and spacing of the points around the vehicle where true safety is computed, m.
NEAR_M, STEP_M = 15.0, 0.5
#: Scans between assessments, as by ``publish.lss_rate``.
ASSESSMENT_SCANS = 5


class Fields:
    """Ground without end along x: a simulated field, continued by reflection."""

    def __init__(self, seed: int) -> None:
        made = hazard_field(np.random.default_rng(seed), HazardField(size=SIDE))
        self._post = SCALE * float(made.x[1] - made.x[0])
        self._made, self._y = SCALE * made.elevation, SCALE * made.y
        self._part: tuple[int, Terrain] | None = None

    def terrain_around(self, x: float, y: float) -> Terrain:
        """Ground within 50 m of a place along x."""
        part = round(x / PART_LENGTH)
        if self._part is None or self._part[0] != part:
            count = self._made.shape[1] - 1
            first, last = (round((part * PART_LENGTH + by) / self._post) for by in (-50.0, 50.0))
            posts = np.arange(first, last + 1)
            folded = count - np.abs(posts % (2 * count) - count)
            self._part = part, Terrain(posts * self._post, self._y, self._made[:, folded])
        return self._part[1]


def main() -> None:
    """Print a table with a column for each seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="9481-9482", help="first-last")
    parser.add_argument("--length", type=float, default=1000.0, help="of the way, m")
    parser.add_argument("--moments", type=int, default=100)
    options = parser.parse_args()
    seeds = parse_seeds(options.seeds)
    print(machine())
    config = configuration("drone", domain__follow="vehicle")
    flown = [fly(seed, options, config) for seed in seeds]
    rows = [[name, *(of[k][1] for of in flown)] for k, (name, _) in enumerate(flown[0])]
    title = f"{options.length:g} m"
    table(title, ["", *(f"seed {seed}" for seed in seeds)], rows)


def scans(seed: int, count: int) -> Iterator[tuple[Array, Terrain, Array, Pose]]:
    """Yield true position, ground, points and estimated pose of each scan."""
    fields, noise = Fields(seed), np.random.default_rng([seed, 1])
    times = np.arange(count) / RATE
    distance = np.linspace(-25.0, 25.0, count)
    true = np.column_stack([SPEED * times, distance, np.full(count, HEIGHT)])
    down = look_at(true, true - (0.0, 0.0, 1.0), NORTH)
    navigation = DriftingNavigation(attitude_bias_deg=0.02, attitude_drift_deg=0.005)
    estimate = navigation.estimate(np.random.default_rng([seed, 2]), times, true, down)
    lidar = FlashLidar(FIELD_OF_VIEW, range_noise=0.02)
    for k in range(count):
        ground = fields.terrain_around(*true[k, :2])
        points = lidar.scan(ground, true[k], down[k], noise).astype(np.float32)
        stamp_ns = 10**9 + round(1e9 * times[k])
        pose = Pose(stamp_ns, estimate.positions[k], estimate.rotations[k], estimate.covariance)
        yield true[k], ground, points, pose


def fly(seed: int, options: argparse.Namespace, config: Config) -> list[list[str]]:
    """Rows of the table of one flight."""
    count = int(options.length / SPEED * RATE)
    mapper, selector = Mapper(config), LandingSiteSelector(config)
    moments = set(np.linspace(50, count - 1, options.moments).astype(int).tolist())
    memory, delays, places, moves, longest = [], [], [], 0, 0.0
    for k, (true, ground, points, pose) in enumerate(scans(seed, count)):
        before, began = mapper.domain, time.thread_time()
        mapper.update(points, pose)
        update_s = time.thread_time() - began
        if mapper.domain != before:
            moves, longest = moves + 1, max(longest, update_s)
        if k + ASSESSMENT_SCANS in moments:  # the next assessment reuses unchanged parts
            selector.assess(round_trip(mapper.snapshot()))
        if k in moments:
            began = time.thread_time()
            cells = mapper.snapshot()
            records = encode_cells(cells)
            mapped = update_s + time.thread_time() - began
            began = time.thread_time()
            d = cells.domain
            given = cells.observed, d.xmin, d.ymin, cells.stamp_ns, config.lss, cells.known
            heard = decode_cells(records, *given)
            x, y, z = pose.position.tolist()
            found = selector.assess(heard, vehicle=(z, 0.0, x, y, SPEED, 0.0))
            delays.append((mapped, mapped + time.thread_time() - began))
            places.append(evaluate_place(found.now, true, ground, config))
            memory.append((resident(), mapper.leaves.count, mapper.leaves.capacity))
    return table_rows(np.array(memory), np.array(delays), np.array(places), moves, longest)


def evaluate_place(now: Array, at: Array, ground: Terrain, config: Config) -> tuple[float, ...]:
    """Whether there is truly safe ground nearby, whether a place is selected and truly safe, its
    predicted probability, and its distance, m."""
    step = np.arange(-NEAR_M, NEAR_M + STEP_M, STEP_M)
    around = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    around = at[:2] + around[np.hypot(*around.T) <= NEAR_M]
    named = np.isfinite(now[3])
    stands = safe(ground, now[None, :2], config)[0] if named else False
    distance = float(np.hypot(*(now[:2] - at[:2])))
    return float(safe(ground, around, config).any()), float(named), float(stands), now[3], distance


def safe(ground: Terrain, places: Array, config: Config) -> Mask:
    """True safety (K,) at places (K, 2)."""
    return contact_safe(ground, places, lander_of(config))


def resident() -> float:
    """Memory of this process, including the simulation, MB."""
    with Path("/proc/self/statm").open(encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def table_rows(
    memory: Array, delays: Array, places: Array, moves: int, longest: float
) -> list[list[str]]:
    """Rows of the table."""
    third = max(len(memory) // 3, 1)
    near = places[:, 0] > 0.0
    stands = places[near, 2] > 0.0
    delays = np.percentile(delays, (50, 95, 100), axis=0).T
    return [
        ["moves of the square", f"{moves}"],
        ["longest scan update with a move, ms", f"{1e3 * longest:.0f}"],
        ["leaves, least and most", "{:.0f}, {:.0f}".format(*np.sort(memory[:, 1])[[0, -1]])],
        ["rows of the table at the end", f"{memory[-1, 2]:.0f}"],
        [
            "memory of the process, most of the first, of the last third, MB",
            f"{memory[:third, 0].max():.0f}, {memory[-third:, 0].max():.0f}",
        ],
        ["map behind, median, 95 %, most, s", "{:.3f}, {:.3f}, {:.3f}".format(*delays[0])],
        ["sites behind, median, 95 %, most, s", "{:.3f}, {:.3f}, {:.3f}".format(*delays[1])],
        [f"moments, with truly safe ground within {NEAR_M:g} m", f"{len(places)}, {near.sum()}"],
        ["of these a place is named", f"{int(places[near, 1].sum())}"],
        ["and the lander stands there", f"{int(stands.sum())}"],
        ["probability given on average, %", f"{100.0 * np.nanmean(places[near, 3]):.2f}"],
        ["distance from the vehicle, median and most, m",
         f"{np.nanmedian(places[:, 4]):.1f}, {np.nanmax(places[:, 4]):.1f}"],
    ]  # fmt: skip


if __name__ == "__main__":
    main()
