# SPDX-License-Identifier: Apache-2.0
"""Both nodes as processes on a simulated Morpheus flight in real time, over DDS with reliable QoS.

Scans of 128 x 128 at 20 Hz, poses at 100 Hz; the flight of 20 s is repeated with increasing stamps.
The script prints latencies from the stamp of a scan to the publication of map and sites, processor
time, memory and losses. A separate process subscribes to sites and target, as guidance does, and in
the first of two flights also to the map.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
import psutil
import rclpy
from common import machine, table
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2

from quadtree_lss.desk.player.player import wait_for_subscribers
from quadtree_lss.desk.replay.configuration import find_config
from quadtree_lss.lab.live.processes import NodeProcess, local_domain
from quadtree_lss.lab.simulation.recording import SCAN_TOPIC, Messages
from quadtree_lss.lab.simulation.simulate import Simulation
from quadtree_lss.onboard.messages.clouds import stamp_ns
from quadtree_lss.onboard.nodes.qos import latched, stream
from quadtree_lss.onboard.nodes.ros_messages import TYPES, packed

SECOND_NS = 1_000_000_000
POSE_NS = 10_000_000
CELLS, SITES, SELECTED = "map/cells", "landing/sites", "landing/selected"
GUIDANCE = {SITES: PoseArray, SELECTED: PoseWithCovarianceStamped}
"""Topics of guidance; then only ``lss_node`` subscribes to the map."""
GUIDANCE_AND_MAP = {CELLS: PointCloud2, **GUIDANCE}
Stamps = NDArray[np.int64]


@dataclass(frozen=True)
class Script:
    """Serialised messages of one flight in order, with their offsets from its start."""

    offset_ns: list[int]
    is_scan: list[bool]
    content: list[bytearray]
    period_ns: int


@dataclass
class Observed:
    """Stamp and time of reception of each message, ns; last diagnostics."""

    received: dict[str, list[tuple[int, int]]] = field(default_factory=dict)
    diagnostics: dict[str, dict[str, str]] = field(default_factory=dict)


@dataclass
class Usage:
    """Processor time and memory of one process, sampled about once a second."""

    process: psutil.Process
    seconds: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    memory_mb: list[float] = field(default_factory=list)
    _earlier_cpu: float = 0.0

    def sample(self) -> None:
        spent = self.process.cpu_times()
        self.seconds.append(time.monotonic())
        self.cpu.append(self._earlier_cpu + spent.user + spent.system)
        self.memory_mb.append(self.process.memory_info().rss / 2**20)

    def follow(self, process: psutil.Process) -> None:
        """Continue with another process, whose processor time begins at zero."""
        self.process = process
        self._earlier_cpu = self.cpu[-1] if self.cpu else 0.0

    def share(self, first: int = 0, last: int = -1) -> float:
        """Per cent of one core from sample ``first`` to ``last``."""
        seconds = self.seconds[last] - self.seconds[first]
        return 100.0 * (self.cpu[last] - self.cpu[first]) / seconds


@dataclass(frozen=True)
class Flight:
    """Outcome of `fly`."""

    sent: Stamps
    observed: Observed
    usage: dict[str, Usage]
    late_ms: float
    recovery_s: list[tuple[str, float]] = field(default_factory=list)


def write_script(seed: int) -> Script:
    """Simulate a flight and serialise its messages."""
    simulation = Simulation("morpheus", seed)
    simulation.make = Messages(TYPES, packed)
    messages = [(topic == SCAN_TOPIC, message) for topic, _, message in simulation.messages()]
    scans = [stamp_ns(message.header) for is_scan, message in messages if is_scan]
    start, period = scans[0] - POSE_NS // 2, len(scans) * (scans[1] - scans[0])
    items = sorted(
        (stamp_ns(message.header) - start, is_scan, bytearray(serialize_message(message)))
        for is_scan, message in messages
    )
    items = [item for item in items if 0 <= item[0] < period]
    offsets, kinds, contents = (list(column) for column in zip(*items, strict=True))
    return Script(offsets, kinds, contents, period)


def observe(
    domain: int, ready: Event, stop: Event, out: Any, topics: Mapping[str, type[Any]]
) -> None:
    """Process that records the arrival of messages and finally puts an `Observed` into ``out``."""
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node("observer", context=context)
    seen = Observed({topic: [] for topic in topics})

    def note(topic: str) -> Any:
        def record(raw: bytes) -> None:
            now = time.time_ns()
            seconds, nanoseconds = struct.unpack_from("<iI", raw, 4)
            seen.received[topic].append((seconds * SECOND_NS + nanoseconds, now))

        return record

    def keep(message: Any) -> None:
        for status in message.status:
            values = seen.diagnostics.setdefault(status.name, {})
            values |= {item.key: item.value for item in status.values}

    for topic, kind in topics.items():
        node.create_subscription(kind, topic, note(topic), latched(), raw=True)
    node.create_subscription(DiagnosticArray, "/diagnostics", keep, 10)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    while not all(node.count_publishers(topic) for topic in (CELLS, SITES)):
        executor.spin_once(timeout_sec=0.1)
    ready.set()
    while not stop.is_set():
        executor.spin_once(timeout_sec=0.2)
    out.put(seen)
    context.try_shutdown()


def fly(
    script: Script,
    seconds: float,
    folder: Path,
    *,
    extra: Sequence[str] = (),
    kill_every: float = 0.0,
    topics: Mapping[str, type[Any]] = GUIDANCE_AND_MAP,
) -> Flight:
    """Start the nodes and play the script for some time.

    Args:
        extra: ROS arguments of both nodes.
        kill_every: Period at which the nodes are killed and restarted in turn, s; 0 for never.
        topics: Topics that a separate process subscribes to.
    """
    args = ["--params-file", str(find_config("morpheus"))]
    args += ["-p", "qos_overrides./lidar/points.subscription.reliability:=reliable", *extra]
    spawn = multiprocessing.get_context("spawn")
    ready, stop, out = spawn.Event(), spawn.Event(), spawn.Queue()
    with ExitStack() as stack:
        domain = stack.enter_context(local_domain(folder / "log"))
        observer = spawn.Process(
            target=observe, args=(domain, ready, stop, out, topics), daemon=True
        )
        observer.start()
        nodes = [
            stack.enter_context(NodeProcess(name, args, folder / f"{name}.txt"))
            for name in ("mapping_node", "lss_node")
        ]
        if not ready.wait(30.0):
            msg = "the nodes' topics are not there after 30 s"
            raise RuntimeError(msg)
        usage = {node.name: Usage(psutil.Process(node.process.pid)) for node in nodes}
        killed: list[tuple[str, int]] = []

        def restart_next_node() -> None:
            turn = len(killed) % len(nodes)
            nodes[turn].process.kill()
            nodes[turn].process.wait()
            name = nodes[turn].name
            log = folder / f"{name}_{len(killed)}.txt"
            nodes[turn] = stack.enter_context(NodeProcess(name, args, log))
            usage[name].follow(psutil.Process(nodes[turn].process.pid))
            killed.append((name, time.time_ns()))

        sent, delay = play(script, seconds, domain, usage, kill_every, restart_next_node)
        time.sleep(3.0)
        for node in nodes:
            node.check()
        stop.set()
        seen = out.get(timeout=30.0)
        observer.join(10.0)
        codes = [node.stop() for node in nodes]
        if any(codes):
            msg = f"nodes ended with exit codes {codes}"
            raise RuntimeError(msg)
    flight = Flight(np.array(sent, dtype=np.int64), seen, usage, delay)
    for name, at in killed:
        topic = CELLS if name == "mapping_node" else SITES
        later = [t for stamp, t in seen.received[topic] if t > at and stamp > at]
        flight.recovery_s.append((name, (later[0] - at) / SECOND_NS if later else float("inf")))
    return flight


def play(
    script: Script,
    seconds: float,
    domain: int,
    usage: dict[str, Usage],
    kill_every: float,
    kill: Callable[[], None],
) -> tuple[list[int], float]:
    """Repeat the flight with increasing stamps; return the scans' stamps and the longest delay of a
    scan behind its stamp, ms."""
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node("lidar", context=context)
    profile = stream(200, reliable=True)
    scans = node.create_publisher(PointCloud2, "lidar/points", profile)
    poses = node.create_publisher(PoseWithCovarianceStamped, "nav/pose", profile)
    sent: list[int] = []
    delay = sampled = 0
    try:
        wait_for_subscribers(node, [scans, poses], 30.0)
        start = killed = time.time_ns()
        for number in itertools.count():
            turn, k = divmod(number, len(script.content))
            due = start + turn * script.period_ns + script.offset_ns[k]
            if due >= start + seconds * SECOND_NS:
                return sent, delay / 1e6
            time.sleep(max(due - time.time_ns(), 0) / SECOND_NS)
            struct.pack_into("<iI", script.content[k], 4, *divmod(due, SECOND_NS))
            (scans if script.is_scan[k] else poses).publish(bytes(script.content[k]))
            if script.is_scan[k]:
                sent.append(due)
                delay = max(delay, time.time_ns() - due)
            if due - sampled >= SECOND_NS:
                sampled = due
                for each in usage.values():
                    each.sample()
            if kill_every and due > killed + kill_every * SECOND_NS:
                killed = due
                kill()
    finally:
        context.try_shutdown()


def latencies_ms(sent: Stamps, received: Sequence[tuple[int, int]]) -> tuple[Any, Any]:
    """Latencies of messages from their stamps, and of scans to the first message with them."""
    stamps = np.array([stamp for stamp, _ in received], dtype=np.int64)
    times = np.array([at for _, at in received], dtype=np.int64)
    of_messages = (times - stamps)[np.isin(stamps, sent)] / 1e6
    first = np.searchsorted(np.maximum.accumulate(stamps), sent)
    within = first < len(times)
    return of_messages, (times[first[within]] - sent[within]) / 1e6


def report(flight: Flight, without_map: Flight | None) -> None:
    """Print latencies and loads. The latency of a message counts from the newest scan in it, that
    of every scan to the first message with it."""
    rows = []
    for topic in (CELLS, SITES, SELECTED):
        messages, scans = latencies_ms(flight.sent, flight.observed.received[topic])
        for name, values in (("message", messages), ("every scan", scans)):
            rows.append([f"`{topic}`, {name}", len(values), *_median_p95_max(values)])
    table("Latency, ms", ["", "number", "median", "95 %", "worst"], rows)
    rows = []
    for name, usage in flight.usage.items():
        memory = usage.memory_mb
        shown = memory[min(60, len(memory) // 2)], memory[-1], max(memory)
        shares = [share(of, [name]) for of in (without_map, flight)]
        rows.append([f"`{name}`", *shares, *(f"{size:.0f}" for size in shown)])
    table(
        "CPU, % of a core, if only guidance listens, and if another node receives the map",
        ["", "guidance", "map", "MB early", "MB last", "MB most"],
        rows,
    )
    mapped = int(flight.observed.diagnostics.get("mapping_node", {}).get("scans", 0))
    if not flight.recovery_s:
        print(f"\n{len(flight.sent)} scans sent, {len(flight.sent) - mapped} of them not mapped.")
    print(f"the player was at most {flight.late_ms:.0f} ms late", file=sys.stderr)


def report_restarts(recovery_s: Sequence[tuple[str, float]]) -> None:
    """Print the times from the end of a node until new scans are served again."""
    rows = []
    for name in dict.fromkeys(name for name, _ in recovery_s):
        seconds = [time for killed, time in recovery_s if killed == name]
        rows.append([f"`{name}`", len(seconds), f"{np.median(seconds):.1f}", f"{max(seconds):.1f}"])
    table("Restarts of a killed node", ["", "kills", "median, s", "longest, s"], rows)


def share(flight: Flight | None, names: Sequence[str]) -> str:
    """Total load of some nodes, per cent of a core."""
    return "-" if flight is None else f"{sum(flight.usage[of].share() for of in names):.1f}"


def _median_p95_max(values: Any) -> list[str]:
    if not len(values):
        return ["-", "-", "-"]
    return [f"{v:.1f}" for v in (np.median(values), np.percentile(values, 95), values.max())]


def main() -> None:
    """Run the flights and print their figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="of flight")
    parser.add_argument("--seed", type=int, default=101)
    text = "kill a node every S seconds and start it again, with checkpoints"
    parser.add_argument("--kill", type=float, default=0.0, metavar="S", help=text)
    options = parser.parse_args()
    print(machine())
    extra: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        if options.kill:
            extra += ["-p", f"checkpoint.path:={folder}/checkpoint.map"]
        script, options_of_fly = (
            write_script(options.seed),
            {"extra": extra, "kill_every": options.kill},
        )
        flight = fly(script, options.seconds, Path(folder), **options_of_fly)
        options_of_fly["topics"] = GUIDANCE
        without_map = (
            None if options.kill else fly(script, options.seconds, Path(folder), **options_of_fly)
        )
    if options.kill:
        report_restarts(flight.recovery_s)
    else:
        report(flight, without_map)


if __name__ == "__main__":
    main()
