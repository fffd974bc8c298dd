# SPDX-License-Identifier: Apache-2.0
"""``make demo``: replay a bag offline and through the nodes, compare the results, fly a lander."""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from quadtree_lss.desk.bags.bag import Bag
from quadtree_lss.desk.exchange.saved import cells_arrays, load_results
from quadtree_lss.desk.player.player import play, played_topics
from quadtree_lss.desk.replay.configuration import find_config
from quadtree_lss.desk.replay.stream import Part
from quadtree_lss.lab.flight.flight_page import headline, write_flight
from quadtree_lss.lab.flight.settings import flight_settings
from quadtree_lss.lab.live import processes
from quadtree_lss.lab.live.flight import fly_live
from quadtree_lss.lab.live.listener import TOPICS, Listener
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.errors import QuadtreeLssError
from quadtree_lss.onboard.messages.outputs import map_from_messages

#: Largest difference between live and offline sites, m; ``sites.csv`` is text.
SITE_TOLERANCE_M = 1e-6


class DemoError(QuadtreeLssError):
    """A step of the demonstration failed."""


def run_live(
    bag: Path,
    params: Path,
    last_stamp_ns: int,
    folder: Path,
    *,
    rate: float = 1.0,
    given: int | None = None,
) -> tuple[CellMap, Array]:
    """Play a bag to both nodes; return the map of ``last_stamp_ns`` and its sites (K, 3).

    The nodes write their output to ``folder``. ``given`` is the ROS domain, by default a free one.
    Raises `DemoError`: no sites; `ProcessError`: a node ended, or others publish the same topics.
    """
    # The comparison with the replay requires that no scan is lost on a busy computer.
    qos = "qos_overrides./lidar/points.subscription"
    lossless = (f"{qos}.reliability:=reliable", f"{qos}.depth:=500")
    lossless += ("pose.max_wait:=10.0", "diagnostics.warn_age:=100.0")
    args = ["--params-file", str(params), *(word for one in lossless for word in ("-p", one))]
    with ExitStack() as stack:
        domain = stack.enter_context(processes.local_domain(folder, given))
        listener = stack.enter_context(Listener(domain))
        published = (*TOPICS, "lidar/points", "nav/pose", "/clock")
        processes.check_publishers(listener.node, dict.fromkeys(published, 0))
        nodes = [
            stack.enter_context(processes.NodeProcess(name, args, folder / f"{name}.txt"))
            for name in ("mapping_node", "lss_node")
        ]
        with Bag(bag) as source:
            play(source, played_topics(source), Part.of(source), rate=rate, wait=30.0)

        def complete() -> bool:
            for node in nodes:
                node.check()
            topics = ("map/cells", "map/observed", "landing/sites")
            return all(listener.stamp(topic) == last_stamp_ns for topic in topics)

        if not listener.wait_for(complete, timeout=20.0):
            stamps = {topic: listener.stamp(topic) for topic in listener.newest}
            raise DemoError(f"no sites for the scan at {last_stamp_ns} ns; newest stamps: {stamps}")
        codes = {node.name: node.stop() for node in nodes}
        if any(codes.values()):
            raise DemoError(f"nodes did not end cleanly: exit codes {codes}")
        newest = listener.newest
    places = [pose.position for pose in newest["landing/sites"].poses]
    position = np.array([(p.x, p.y, p.z) for p in places], dtype=np.float64).reshape(-1, 3)
    return map_from_messages(newest["map/cells"], newest["map/observed"]), position


def differing(path: Path, cells: CellMap) -> list[str]:
    """Names of the arrays that differ between ``cells.npz`` and a map; NaN equals NaN."""
    own = cells_arrays(cells)
    with np.load(path) as file:
        both = sorted({*file.files} & {*own})
        differ = [n for n in both if not np.array_equal(file[n], own[n], equal_nan=True)]
        return sorted({*file.files} ^ {*own}) + differ


def _program(name: str, *args: str) -> None:
    done = subprocess.run([str(processes.program(name)), *args], check=False)
    if done.returncode != 0:
        raise DemoError(f"{name} {' '.join(args)} ended with exit code {done.returncode}")


def demonstrate(out: Path, seed: int) -> bool:
    """Run all steps; return whether live and offline results agree."""
    bag, offline, live = out / "flight" / "bag", out / "offline", out / "live"
    for folder in (bag.parent, offline, live, out / "lander"):
        shutil.rmtree(folder, ignore_errors=True)
    out.mkdir(parents=True, exist_ok=True)
    bag.parent.mkdir()
    params = find_config("morpheus")
    print(f"1. Simulate 4 s of the Morpheus flight, seed {seed}", flush=True)
    _program("simulate", "morpheus", "--seed", f"{seed}", "--duration", "4", "--out", str(bag))
    print("2. Replay the bag offline", flush=True)
    _program("replay_bag", str(bag), "--out", str(offline), "--config", str(params))
    results = load_results(offline)
    stamps = results.timing["stamp_ns"]
    print("3. Play the bag over DDS to mapping_node and lss_node", flush=True)
    started = time.monotonic()
    domain = processes.environment_domain()
    cells, sites = run_live(bag, params, int(stamps[-1]), live, given=domain)
    took = f"{time.monotonic() - started:.1f} s with start-up"
    print(f"   {len(stamps)} scans, {len(cells.level)} leaves, {took}")
    best = "".join(f", the best at x {x:.2f}, y {y:.2f} m" for x, y, _ in sites[:1])
    print(f"4. lss_node ranks {len(sites)} landing sites{best}", flush=True)
    unequal = differing(offline / "cells.npz", cells)
    expected = results.positions
    if sites.shape != expected.shape or np.abs(sites - expected).max(initial=0) > SITE_TOLERANCE_M:
        unequal.append("sites")
    comparison = f"different {', '.join(unequal)}" if unequal else "the same map and the same sites"
    print(f"5. Nodes against offline replay: {comparison}")
    print("6. A lander flies the last 260 m by landing/selected, over DDS", flush=True)
    short = {"slant_range": 260.0, "speed": 26.0, "half": 12.0, "survey": 4.0}
    nodes = out / "lander" / "nodes"
    flown = fly_live(seed, flight_settings(short), nodes, domain=domain)
    write_flight(out / "lander", flown)
    print(f"   {headline(flown)}")
    print("7. Export the results for GIS and 3D programs", flush=True)
    export = [str(processes.program("quadtree-lss")), "export", str(offline)]
    exported = subprocess.run(export, check=False)
    print(f"\nOpen {offline / 'report.html'}: the sites, the map, the ground in 3D")
    print(f"Open {out / 'lander' / 'flight.html'}: the landing")
    if exported.returncode == 0:
        print(f"GeoTIFFs of every layer: {offline / 'exchange'}/*.tif")
    return not unequal


def main(args: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="demo", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("demo_output"), help="results folder")
    parser.add_argument("--seed", type=int, default=1, help="of the simulated field and flight")
    options = parser.parse_args(args)
    try:
        return 0 if demonstrate(options.out, options.seed) else 1
    except QuadtreeLssError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
