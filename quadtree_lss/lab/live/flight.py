# SPDX-License-Identifier: Apache-2.0
"""A flight with the real nodes over DDS; ``/clock`` carries its simulated time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from quadtree_lss.desk.player.player import PlayError, wait_for_subscribers
from quadtree_lss.desk.replay.assessments import TargetChange
from quadtree_lss.desk.replay.configuration import dump_config
from quadtree_lss.lab.flight.flight import START_NS, TICK, Flight, FlightMessage, flight_config
from quadtree_lss.lab.flight.fly import FlightResult, flight_figures, run_flight
from quadtree_lss.lab.flight.settings import FlightSettings
from quadtree_lss.lab.live.listener import TOPICS, Listener
from quadtree_lss.lab.live.processes import NodeProcess, check_publishers, local_domain
from quadtree_lss.lab.simulation.recording import CLOUD, POSE, Messages
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.landing.target import Reason
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.messages import landing_inputs, outputs
from quadtree_lss.onboard.messages.clouds import stamp_ns
from quadtree_lss.onboard.messages.landing_inputs import LandingRequests
from quadtree_lss.onboard.messages.outputs import CELLS, OBSERVED, SELECTED, SITES, STATUS
from quadtree_lss.onboard.nodes.qos import latched, stream
from quadtree_lss.onboard.nodes.ros_messages import TYPES, packed, time_message

REQUESTS = ("dispersion", "area", "keep_out", "target")
TOPIC_KINDS = {"nav/pose": POSE, "lidar/points": CLOUD}
TOPIC_KINDS |= {f"landing/{name}": landing_inputs.TYPES[name] for name in REQUESTS}
#: Largest time until the nodes subscribe, s.
MAX_STARTUP_S = 30.0


def fly_live(
    seed: int,
    settings: FlightSettings,
    folder: Path,
    *,
    progress: Callable[[float], None] | None = None,
    domain: int | None = None,
) -> FlightResult:
    """Fly with both nodes as processes; their parameters, checkpoint and output go to ``folder``.

    The avoidance must be ``package`` or ``paper``. ``domain``: by default a free one. Raises
    `PlayError`: the nodes did not start in time; `ProcessError`: a node is not installed or has
    ended, or others publish the same topics.
    """
    flight = Flight(seed, settings)
    config = flight_config(settings, flight.ground)
    with ExitStack() as stack:
        nodes = LiveNodes(stack, config, folder, domain)
        run_flight(flight, nodes, progress)
        cells, requests = nodes.map(), nodes.requests
    last = None
    if cells is not None:  # as in lss_node, except for the target, which depends on earlier maps
        last = LandingSiteSelector(config).assess(cells, **requests.arguments())
    figures = flight_figures(seed, flight, last)
    targets, more = tuple(nodes.targets), {"landing": requests.as_lists()}
    more |= {"target": targets[-1].id if targets else 0, "target_changes": len(targets)}
    more |= {"target_why": nodes.why, "target_reason": ""}
    return FlightResult(flight, figures, last, cells, None, targets, more)


class LiveNodes:
    """Both nodes as processes that end with ``stack``. ``requests``: last ones of guidance;
    ``targets``: changes of the target in ``landing/status``; ``why``: its last reason."""

    def __init__(self, stack: ExitStack, config: Config, folder: Path, domain: int | None) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        params, self._checkpoint = folder / "params.yaml", folder / "checkpoint.npz"
        params.write_text(dump_config(config), encoding="utf-8")
        self._checkpoint.unlink(missing_ok=True)
        self._args = ["--params-file", str(params), "-p", "use_sim_time:=true"]
        self._args += ["-p", "qos_overrides./lidar/points.subscription.reliability:=reliable"]
        self._args += ["-p", f"checkpoint.path:={self._checkpoint}"]
        self._stack, self._folder = stack, folder
        domain = stack.enter_context(local_domain(folder, domain))
        topics = {topic: TOPICS[topic] for topic in (CELLS, OBSERVED, SITES)}
        self._listener = stack.enter_context(Listener(domain, topics, "flight"))
        node = self._node = self._listener.node
        self._make = Messages(TYPES, packed, config.frames.map)
        self._clock = node.create_publisher(Clock, "/clock", stream(10, reliable=True))
        self._publishers = {}
        for topic, kind in TOPIC_KINDS.items():
            profile = latched() if topic.startswith("landing/") else stream(200, reliable=True)
            self._publishers[topic] = node.create_publisher(TYPES[kind], topic, profile)
        self._service = node.create_client(Trigger, "lss_node/land_now")
        self._received: list[Array | None] = []
        self.requests, self.targets = LandingRequests(config.frames.map), list[TargetChange]()
        self.why = ""
        node.create_subscription(TOPICS[SELECTED], SELECTED, self._on_selected, latched())
        node.create_subscription(TOPICS[STATUS], STATUS, self._on_status, latched())
        ours = dict.fromkeys(("/clock", *TOPIC_KINDS), 1)
        check_publishers(node, ours | dict.fromkeys(TOPICS, 0))
        self._killed: set[str] = set()
        self._nodes = {name: self._start(name) for name in ("mapping", "lss")}
        try:
            wait_for_subscribers(node, list(self._publishers.values()), MAX_STARTUP_S)
        except PlayError:
            for process in self._nodes.values():
                process.check()
            raise
        # lss_node waits for the first keep-out message; this one is empty.
        self.publish(FlightMessage("landing/keep_out", START_NS, np.zeros((0, 2))), START_NS)
        self._began = time.monotonic()

    def publish(self, sent: FlightMessage, now_ns: int) -> None:
        message = sent.message(self._make)
        if sent.topic.startswith("landing/"):
            self.requests.use_message(sent.topic.removeprefix("landing/"), message)
        elif sent.topic == "nav/pose":
            self.requests.navigation.use_pose(message)
        self._publishers[sent.topic].publish(message)

    def step(self, now_ns: int) -> list[Array | None]:
        """Publish the time, wait until it is reached, and return the targets received since."""
        self._clock.publish(Clock(clock=time_message(now_ns)))
        seconds = 1e-9 * (now_ns - START_NS)
        time.sleep(max(self._began + seconds - time.monotonic(), 0.0))
        tick = round(seconds / TICK)
        for name in self._nodes.keys() - self._killed if tick % 100 == 0 else ():
            self._nodes[name].check()
        count = len(self._received)
        said, self._received[:count] = self._received[:count], []
        return said

    def land_now(self) -> None:
        self._service.call_async(Trigger.Request())

    def kill(self, node: str) -> None:
        self._killed.add(node)
        self._nodes[node].process.kill()
        self._nodes[node].process.wait()

    def respawn(self, node: str, *, checkpoint: bool = True) -> None:
        if not checkpoint:
            self._checkpoint.unlink(missing_ok=True)
        self._killed.discard(node)
        self._nodes[node] = self._start(node)

    def map(self) -> CellMap | None:
        """Return the last map whose sites have arrived; its messages share one stamp."""
        heard = self._listener
        topics = (CELLS, OBSERVED, SITES)
        heard.wait_for(lambda: len({heard.stamp(topic) for topic in topics}) == 1, 2.0)
        if heard.stamp(CELLS) != heard.stamp(OBSERVED) or CELLS not in heard.newest:
            return None
        return outputs.map_from_messages(heard.newest[CELLS], heard.newest[OBSERVED])

    def _start(self, name: str) -> NodeProcess:
        log = self._folder / f"{name}_{time.monotonic_ns()}.txt"
        return self._stack.enter_context(NodeProcess(f"{name}_node", self._args, log))

    def _on_status(self, message: Any) -> None:
        said = outputs.status_from_message(message)
        x, y, z, share = (float(said[name]) for name in ("x", "y", "z", "probability"))
        stamp, reason = stamp_ns(message.header), Reason(said["reason"]).key
        row = TargetChange(stamp, int(said["id"]), x, y, z, share, reason)
        self.why = f"{'target' if row.id else 'no target'}: {Reason(said['reason']).text}"
        if row.differs_from(self.targets[-1] if self.targets else None):
            self.targets.append(row)

    def _on_selected(self, message: Any) -> None:
        place = message.pose.pose.position
        known = not math.isnan(place.x)
        self._received.append(np.array([place.x, place.y, place.z]) if known else None)
