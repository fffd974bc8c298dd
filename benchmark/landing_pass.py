# SPDX-License-Identifier: Apache-2.0
"""CPU time of one landing-site assessment, by map size, grid and method."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import Recording, configuration, machine, recording, table

from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.messages.maps import round_trip


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=101)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--duration", type=float, help="duration of the flight, s")
    options = parser.parse_args()
    print(machine())
    flight = recording("morpheus", options.seed, options.duration)
    rows, mapped, cells = [], None, None
    for name, changes in CASES:
        config = configuration("morpheus", **changes)
        if config.domain != mapped:
            mapped, cells = config.domain, map_of(flight, config)
        rows.append([name, *measure(cells, config, options.repeats)])
    table(
        "One assessment by a new selector, CPU ms",
        ["map", "leaves", "grid points", "best", "median", "worst"],
        rows,
    )
    table(
        f"Assessments that follow the flight, one every {EVERY} scans, CPU ms",
        ["selector", "maps", "best", "median", "95 %"],
        follow(flight, configuration("morpheus")),
    )


WIDE = {"domain__xmin": -64.0, "domain__ymin": -64.0, "domain__size": 128.0}
WIDE |= {"domain__min_level": 5, "domain__max_level": 9}
CASES: tuple[tuple[str, dict[str, object]], ...] = (
    ("64 m, leaves 4 to 0.25 m, grid 0.25 m", {}),
    ("  grid 0.5 m", {"lss__grid_spacing": 0.5}),
    ("  grid 1 m", {"lss__grid_spacing": 1.0}),
    ("  the paper's rules", {"lss__assessment": "paper"}),
    ("  margin 2 m", {"lss__margin": 2.0}),
    ("64 m, all leaves 0.25 m", {"domain__min_level": 8}),
    ("64 m, leaves to 0.5 m", {"domain__max_level": 7}),
    ("128 m, leaves 4 to 0.25 m, a quarter of it seen", WIDE),
)


#: Scans between published maps: 20 Hz mapped, 4 Hz published.
EVERY = 5


def map_of(flight: Recording, config: Config) -> CellMap:
    """The map of the whole flight."""
    mapper = Mapper(config)
    for scan in flight.scans:
        mapper.update(scan.points_lidar, scan.pose)
    return mapper.snapshot()


def measure(cells: CellMap, config: Config, repeats: int) -> list[str]:
    """Assess a map several times, each time with a new selector."""
    received, spent, found = round_trip(cells), [], None
    for _ in range(repeats + 1):  # the first one warms up
        began = time.process_time()
        found = LandingSiteSelector(config).assess(received)
        spent.append(1e3 * (time.process_time() - began))
    assert found is not None
    times = (min(spent[1:]), np.median(spent[1:]), max(spent[1:]))
    return [f"{len(cells.level):,}", f"{found.safe.size:,}", *(f"{ms:.1f}" for ms in times)]


def follow(flight: Recording, config: Config) -> list[list[str]]:
    """Compare one selector for all maps, as in ``lss_node``, with a new one for each map."""
    mapper, follower = Mapper(config), LandingSiteSelector(config)
    spent: dict[str, list[float]] = {"follows the map": [], "new for each map": []}
    for number, scan in enumerate(flight.scans, start=1):
        mapper.update(scan.points_lidar, scan.pose)
        if number % EVERY:
            continue
        cells = round_trip(mapper.snapshot())
        for name, selector in zip(spent, (follower, LandingSiteSelector(config)), strict=True):
            began = time.process_time()
            selector.assess(cells)
            spent[name].append(1e3 * (time.process_time() - began))
    return [
        [name, f"{len(took):,}", *(f"{ms:.1f}" for ms in np.percentile(took, (0, 50, 95)))]
        for name, took in spent.items()
    ]


if __name__ == "__main__":
    main()
