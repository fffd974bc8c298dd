# SPDX-License-Identifier: Apache-2.0
"""How long mapping_node takes from its start to its first scan, beside sensors that run already.

20 Hz scans of 128 x 128 and 100 Hz poses of a simulated Morpheus flight, over DDS with reliable
QoS. Prints when the node was ready, when it had mapped a scan, and its memory then.
"""

from __future__ import annotations

import argparse
import multiprocessing
import re
import struct
import sys
import tempfile
import time
from contextlib import ExitStack
from multiprocessing.synchronize import Event
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
import psutil
import rclpy
from common import machine, table
from geometry_msgs.msg import PoseWithCovarianceStamped
from live import SECOND_NS, Script, write_script
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from quadtree_lss.desk.replay.configuration import find_config
from quadtree_lss.lab.live.processes import LocalDomain, NodeProcess, local_domain
from quadtree_lss.onboard.nodes.qos import stream

LIMIT_S = 15.0
READY, MAPPED = "quadtree_lss ", "first scan mapped"
"""Of the lines of the node's log."""


def sense(script: Script, domain: int, stop: Event) -> None:
    """Process that plays the flight again and again, whether somebody listens or not."""
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node("lidar", context=context)
    profile = stream(200, reliable=True)
    scans = node.create_publisher(PointCloud2, "lidar/points", profile)
    poses = node.create_publisher(PoseWithCovarianceStamped, "nav/pose", profile)
    start = time.time_ns()
    while not stop.is_set():
        for offset, is_scan, content in zip(
            script.offset_ns, script.is_scan, script.content, strict=True
        ):
            due = start + offset
            time.sleep(max(due - time.time_ns(), 0) / SECOND_NS)
            struct.pack_into("<iI", content, 4, *divmod(due, SECOND_NS))
            (scans if is_scan else poses).publish(bytes(content))
            if stop.is_set():
                break
        start += script.period_ns
    context.try_shutdown()


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


def _told(node: NodeProcess, words: str) -> float:
    """Time of the first line of the node's log with these words, s; 0 if there is none."""
    found = re.search(rf"\[(\d+\.\d+)\][^\n]*{words}", node.output())
    return float(found[1]) if found else 0.0


def main() -> None:
    """Start and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=20)
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
