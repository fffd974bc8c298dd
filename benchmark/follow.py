# SPDX-License-Identifier: Apache-2.0
"""A square that follows, over a kilometre of fields with rocks: 25 m up, 6 m/s, the drone's preset.

A flash lidar of 128 x 128 beams, 45 degrees wide, at 20 Hz: 21 m that the square always holds, and
about forty returns to a leaf while it passes over it. Printed are: memory; by how much map and
sites are behind the vehicle, in CPU seconds from a scan's stamp, as one core for each node would
have it; leaves that stayed inside, beside a map whose fixed domain lay there; and at even moments
the place that ``~/land_now`` would take, by the true ground.

The ground is 105 m wide and there and back again, but the way leads across it, so that no place is
flown over twice. A fixed map sees other parts of the scans than one that follows, and so aligns
them to other ground: leaves are compared where poses are taken as they are.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import configuration, machine, table
from common.as_posed import AsPosed

from quadtree_lss.lab.campaign.study import parse_seeds
from quadtree_lss.lab.evaluation.risk_flights import lander_of
from quadtree_lss.lab.simulation.hazard_field import FIELDS, hazard_field
from quadtree_lss.lab.simulation.lidar import FlashLidar
from quadtree_lss.lab.simulation.navigation import DriftingNavigation
from quadtree_lss.lab.simulation.safety import contact_safe
from quadtree_lss.lab.simulation.terrain import Terrain
from quadtree_lss.lab.simulation.trajectory import NORTH, look_at
from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.config.settings import Config, config_from_values
from quadtree_lss.onboard.core.landing.sites import LandingSiteSelector
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.core.tree.leaves import LEAF
from quadtree_lss.onboard.messages.maps import decode_cells, encode_cells, round_trip

HEIGHT, SPEED, RATE, FIELD_OF_VIEW = 25.0, 6.0, 20.0, 45.0
SCALE, SIDE, ROOM = 0.35, 300.0, 30.0
#: The true ground is looked at this far from the vehicle, every so many metres.
NEAR, EVERY = 15.0, 0.5
#: Scans that a place may have been seen by, and of which the compared maps are made.
KEPT, COMPARED = 200, 8
#: Scans from one landing pass to the next, as ``publish.lss_rate`` has it.
PASS = 5


class Fields:
    """Ground without end along x: one made field, there and back again."""

    def __init__(self, name: str, seed: int) -> None:
        field = FIELDS[name].__class__(**{**vars(FIELDS[name]), "size": SIDE})
        made = hazard_field(np.random.default_rng(seed), field)
        self._post = SCALE * float(made.x[1] - made.x[0])
        self._made, self._y = SCALE * made.elevation, SCALE * made.y
        self._of: tuple[int, Terrain] | None = None

    def about(self, x: float, y: float) -> Terrain:
        """What a lidar at a place can see."""
        part = round(x / ROOM)
        if self._of is None or self._of[0] != part:
            count = self._made.shape[1] - 1
            first, last = (round((part * ROOM + by) / self._post) for by in (-50.0, 50.0))
            posts = np.arange(first, last + 1)
            folded = count - np.abs(posts % (2 * count) - count)
            self._of = part, Terrain(posts * self._post, self._y, self._made[:, folded])
        return self._of[1]


def main() -> None:
    """Print one table, a column for each seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="9481-9482", help="first-last")
    parser.add_argument("--length", type=float, default=1000.0, help="of the way, m")
    parser.add_argument("--moments", type=int, default=100)
    parser.add_argument("--field", default="default", choices=tuple(FIELDS))
    options = parser.parse_args()
    seeds = parse_seeds(options.seeds)
    print(machine())
    config = configuration("drone", domain__follow="vehicle")
    flown = [fly(seed, options, config) for seed in seeds]
    rows = [[name, *(of[k][1] for of in flown)] for k, (name, _) in enumerate(flown[0])]
    title = f"{options.length:g} m over {options.field} ground"
    table(title, ["", *(f"seed {seed}" for seed in seeds)], rows)


def scans(seed: int, field: str, count: int) -> Iterator[tuple[Array, Terrain, Array, Pose]]:
    """True place, ground, points and pose of each."""
    fields, noise = Fields(field, seed), np.random.default_rng([seed, 1])
    times = np.arange(count) / RATE
    away = np.linspace(-25.0, 25.0, count)
    true = np.column_stack([SPEED * times, away, np.full(count, HEIGHT)])
    down = look_at(true, true - (0.0, 0.0, 1.0), NORTH)
    navigation = DriftingNavigation(attitude_bias_deg=0.02, attitude_drift_deg=0.005)
    told = navigation.estimate(np.random.default_rng([seed, 2]), times, true, down)
    lidar = FlashLidar(FIELD_OF_VIEW, range_noise=0.02)
    for k in range(count):
        ground = fields.about(*true[k, :2])
        points = lidar.scan(ground, true[k], down[k], noise).astype(np.float32)
        stamp_ns = 10**9 + round(1e9 * times[k])
        pose = Pose(stamp_ns, told.positions[k], told.rotations[k], told.covariance)
        yield true[k], ground, points, pose


def fly(seed: int, options: argparse.Namespace, config: Config) -> list[list[str]]:
    """Rows of the table of one flight."""
    count = int(options.length / SPEED * RATE)
    mapper, beside, selector = Mapper(config), AsPosed(config), LandingSiteSelector(config)
    kept: deque[tuple[Array, Pose, Domain]] = deque(maxlen=KEPT)
    moments = set(np.linspace(50, count - 1, options.moments).astype(int).tolist())
    compared = set(np.linspace(KEPT, count - 1, COMPARED).astype(int).tolist())
    memory, late, places, same, moves, longest = [], [], [], np.zeros(2, int), 0, 0.0
    for k, (true, ground, points, pose) in enumerate(scans(seed, options.field, count)):
        before, began = mapper.domain, time.thread_time()
        mapper.update(points, pose)
        taken = time.thread_time() - began
        if mapper.domain != before:
            moves, longest = moves + 1, max(longest, taken)
        kept.append((points, pose, beside.domain))
        beside.update(points, pose)
        if k + PASS in moments:  # the pass before: what did not change since is kept
            selector.assess(round_trip(mapper.snapshot()))
        if k in moments:
            began = time.thread_time()
            cells = mapper.snapshot()
            records = encode_cells(cells)
            mapped = taken + time.thread_time() - began
            began = time.thread_time()
            d = cells.domain
            given = cells.observed, d.xmin, d.ymin, cells.stamp_ns, config.lss, cells.known
            heard = decode_cells(records, *given)
            x, y, z = pose.position.tolist()
            found = selector.assess(heard, vehicle=(z, 0.0, x, y, SPEED, 0.0))
            late.append((mapped, mapped + time.thread_time() - began))
            places.append(judge(found.now, true, ground, config))
            memory.append((resident(), mapper.leaves.count, mapper.leaves.capacity))
        if k in compared:
            same += alike(beside, kept)
    return told_of(np.array(memory), np.array(late), np.array(places), same, moves, longest)


def judge(now: Array, at: Array, ground: Terrain, config: Config) -> tuple[float, ...]:
    """Whether there is truly safe ground near; whether a place is named, whether the lander stands
    there, what was told of that, and how far it is."""
    step = np.arange(-NEAR, NEAR + EVERY, EVERY)
    around = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    around = at[:2] + around[np.hypot(*around.T) <= NEAR]
    named = np.isfinite(now[3])
    stands = safe(ground, now[None, :2], config)[0] if named else False
    away = float(np.hypot(*(now[:2] - at[:2])))
    return float(safe(ground, around, config).any()), float(named), float(stands), now[3], away


def safe(ground: Terrain, places: Array, config: Config) -> Mask:
    """(K,) whether the lander stands at places (K, 2)."""
    return contact_safe(ground, places, lander_of(config))


def alike(beside: Mapper, kept: deque[tuple[Array, Pose, Domain]]) -> tuple[int, int]:
    """How many leaves stayed inside ever since their first return, and how many of them are those
    of a fixed map, to the bit."""
    here = beside.domain
    values = {"domain.follow": "none", "domain.xmin": here.xmin, "domain.ymin": here.ymin}
    fixed = AsPosed(config_from_values(values, beside.config))
    fixed._start_ns = beside._start_ns  # times count from the first scan
    side = here.size / 2**here.min_level
    n = 1 << here.min_level
    lost = np.zeros((n, n), dtype=bool)  # seen while it lay outside the square
    corners = np.stack(np.meshgrid(*[np.arange(n) * side] * 2), axis=-1) + (here.xmin, here.ymin)
    for points, pose, then in kept:
        fixed.update(points, pose)
        seen = points.reshape(-1, 3) @ pose.rotation_map_lidar.T + pose.position
        ix, iy = (np.floor((seen[:, axis] - low) / side) for axis, low in enumerate(
            (here.xmin, here.ymin)))  # fmt: skip
        inside = (ix >= 0) & (ix < n) & (iy >= 0) & (iy < n)
        hit = np.zeros((n, n), dtype=bool)
        hit[iy[inside].astype(int), ix[inside].astype(int)] = True
        off = corners - (then.xmin, then.ymin)
        lost |= hit & ~((off >= 0.0) & (off + side <= here.size)).all(axis=-1)
    rows = []
    for mapper in (beside, fixed):
        leaves = mapper.leaves.rows[: mapper.leaves.count]
        shift = leaves["level"] - here.min_level
        stayed = ~lost[leaves["iy"] >> shift, leaves["ix"] >> shift] & (leaves["known"] > 0)
        rows.append(leaves[stayed])
    one, other = (np.frombuffer(of.tobytes(), f"V{LEAF.itemsize}") for of in rows)
    return max(len(one), len(other)), len(np.intersect1d(one, other))


def resident() -> float:
    """Memory of this process, with all that simulates, MB."""
    with Path("/proc/self/statm").open(encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def told_of(
    memory: Array, late: Array, places: Array, same: Array, moves: int, longest: float
) -> list[list[str]]:
    """Rows of the table."""
    third = max(len(memory) // 3, 1)
    near = places[:, 0] > 0.0
    stands = places[near, 2] > 0.0
    late = np.percentile(late, (50, 95, 100), axis=0).T
    return [
        ["moves of the square", f"{moves}"],
        ["longest scan update with a move, ms", f"{1e3 * longest:.0f}"],
        ["leaves, least and most", "{:.0f}, {:.0f}".format(*np.sort(memory[:, 1])[[0, -1]])],
        ["rows of the table at the end", f"{memory[-1, 2]:.0f}"],
        [
            "memory of the process, most of the first, of the last third, MB",
            f"{memory[:third, 0].max():.0f}, {memory[-third:, 0].max():.0f}",
        ],
        ["map behind, median, 95 %, most, s", "{:.3f}, {:.3f}, {:.3f}".format(*late[0])],
        ["sites behind, median, 95 %, most, s", "{:.3f}, {:.3f}, {:.3f}".format(*late[1])],
        ["leaves that stayed inside, and to the bit", f"{same[0]}, {same[1]}"],
        [f"moments, with truly safe ground within {NEAR:g} m", f"{len(places)}, {near.sum()}"],
        ["of these a place is named", f"{int(places[near, 1].sum())}"],
        ["and the lander stands there", f"{int(stands.sum())}"],
        ["probability given on average, %", f"{100.0 * np.nanmean(places[near, 3]):.2f}"],
        ["distance from the vehicle, median and most, m",
         f"{np.nanmedian(places[:, 4]):.1f}, {np.nanmax(places[:, 4]):.1f}"],
    ]  # fmt: skip


if __name__ == "__main__":
    main()
