# SPDX-License-Identifier: Apache-2.0
"""How long mapping_node takes from its start to its first scan, beside sensors that run already.

20 Hz scans of 128 x 128 and 100 Hz poses of a simulated Morpheus flight, over DDS with reliable
QoS. Prints when the node was ready, when it had mapped a scan, and its memory then. With
``--lss 20`` it is lss_node that is started so often, beside sensors and mapping_node: how many gave
sites within 25 s, how many gave none but said why, and how many neither, which must be none.
"""

from __future__ import annotations

import argparse
import multiprocessing
import re
import sys
import tempfile
import time
from contextlib import ExitStack
from multiprocessing.synchronize import Event
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
import psutil
from common import machine, table
from live import Script, play, write_script

from quadtree_lss.desk.replay.configuration import find_config
from quadtree_lss.lab.live.processes import LocalDomain, NodeProcess, local_domain

LIMIT_S = 15.0
READY, MAPPED, SITES = "quadtree_lss ", "first scan mapped", "first sites"
"""Of the lines of the node's log."""


def sense(script: Script, domain: int, stop: Event) -> None:
    """Process that plays the flight again and again, whether somebody listens or not."""
    for _ in play(script, domain):
        if stop.is_set():
            return


def start_once(domain: LocalDomain, log: Path) -> tuple[float, float, float]:
    """Seconds until the node was ready and until it had mapped a scan; memory, MB."""
    args = ["--params-file", str(find_config("morpheus")), "-p", "qos.scan_reliability:=reliable"]
    began = time.time()
    with NodeProcess("mapping_node", args, domain.env, log) as node:
        while not (mapped := _told(node, MAPPED)):
            node.check()
            if time.time() > began + LIMIT_S:
                msg = f"no scan was mapped within {LIMIT_S:g} s: {node.output()}"
                raise RuntimeError(msg)
            time.sleep(0.02)
        memory = psutil.Process(node.process.pid).memory_info().rss / 2**20
        return _told(node, READY) - began, mapped - began, memory


PATIENCE_S = 25.0
"""For sites of a node that was started again."""


def restart_lss(args: list[str], domain: LocalDomain, log: Path) -> tuple[float, str]:
    """Seconds until lss_node gave sites, NaN if it did not in time; the last that it said why."""
    began = time.time()
    with NodeProcess("lss_node", args, domain.env, log) as node:
        while not (found := _told(node, SITES)) and time.time() < began + PATIENCE_S:
            node.check()
            time.sleep(0.1)
        said = [line for line in node.output().splitlines() if "waiting for" in line]
        return (found or np.nan) - began, said[-1].partition("]: ")[2] if said else ""


def restarts(count: int, domain: LocalDomain, folder: Path) -> None:
    """Print what came of so many starts of lss_node."""
    args = ["--params-file", str(find_config("morpheus")), "-p", "qos.scan_reliability:=reliable"]
    load = []
    with NodeProcess("mapping_node", args, domain.env, folder / "mapping.txt") as mapping:
        found = []
        for number in range(count):
            found.append(restart_lss(args, domain, folder / f"lss_{number}.txt"))
            load.append(psutil.getloadavg()[0])
            print(f"{number + 1}: {found[-1][0]:.1f} s {found[-1][1]}", flush=True)
        mapping.check()
    took = np.array([seconds for seconds, _ in found])
    silent = sum(np.isnan(seconds) and not why for seconds, why in found)
    gave = np.count_nonzero(np.isfinite(took))
    title = f"lss_node, {count} starts beside mapping_node and sensors that run"
    most = f"{np.nanmax(took):.1f}" if gave else "-"
    rows = [
        ["gave sites within 25 s", f"{gave} (median {np.nanmedian(took):.1f} s, most {most} s)"],
        ["gave none, said why", f"{count - gave - silent}"],
        ["neither (required 0)", f"{silent}"],
        ["load of two cores meanwhile", f"{min(load):.1f} to {max(load):.1f}"],
    ]
    table(title, ["", "starts"], rows)


def _told(node: NodeProcess, words: str) -> float:
    """Time of the first line of the node's log with these words, s; 0 if there is none."""
    found = re.search(rf"\[(\d+\.\d+)\][^\n]*{words}", node.output())
    return float(found[1]) if found else 0.0


def main() -> None:
    """Start and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--lss", type=int, default=0, metavar="N")
    parser.add_argument("--seed", type=int, default=101)
    options = parser.parse_args()
    print(machine())
    spawn = multiprocessing.get_context("spawn")
    stop = spawn.Event()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        domain = stack.enter_context(local_domain(folder / "log"))
        script = write_script(options.seed)
        sensors = spawn.Process(target=sense, args=(script, domain.number, stop), daemon=True)
        sensors.start()
        start_once(domain, folder / "first.txt")  # waits for the sensors
        if options.lss:
            restarts(options.lss, domain, folder)
            stop.set()
            sensors.join(10.0)
            return
        logs = (folder / f"{number}.txt" for number in range(options.starts))
        found = np.array([start_once(domain, log) for log in logs])
        stop.set()
        sensors.join(10.0)
    names = ("ready, s", "first scan mapped, s (required 1.5)", "memory then, MB (must 130)")
    rows = [
        [name, f"{np.median(column):.2f}", f"{column.min():.2f}", f"{column.max():.2f}"]
        for name, column in zip(names, found.T, strict=True)
    ]
    title = f"mapping_node, {options.starts} starts beside sensors that run"
    table(title, ["", "median", "least", "most"], rows)


if __name__ == "__main__":
    main()
