# SPDX-License-Identifier: Apache-2.0
"""A flight over DDS: the same flight, the real nodes, ``/clock`` in its time."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from quadtree_lss.desk.player.player import PlayError, wait_for_subscribers
from quadtree_lss.desk.replay.configuration import dump_config
from quadtree_lss.lab.flight.flight import START_NS, TICK, Flight, Sent, flight_config
from quadtree_lss.lab.flight.fly import LAND_NOW, Flown, changed, figures_of
from quadtree_lss.lab.flight.pilot import Target
from quadtree_lss.lab.flight.settings import FlightSettings
from quadtree_lss.lab.live.processes import NodeProcess, local_domain, refuse_company, strangers
from quadtree_lss.lab.simulation.recording import CLOUD, POSE, Messages
from quadtree_lss.onboard.core.landing.sites import LandingSiteSelector
from quadtree_lss.onboard.messages import landing_inputs
from quadtree_lss.onboard.messages.outputs import TOPIC_TYPES, map_from_messages
from quadtree_lss.onboard.nodes.diagnostics import Problems
from quadtree_lss.onboard.nodes.losses import Publishers
from quadtree_lss.onboard.nodes.qos import latched, stream, subscribe
from quadtree_lss.onboard.nodes.ros_messages import TYPES, packed, time_message

WISHES = ("dispersion", "area", "keep_out", "target")
KINDS = {"nav/pose": POSE, "lidar/points": CLOUD}
KINDS |= {f"landing/{name}": landing_inputs.TYPES[name] for name in WISHES}
SPOKEN = ("/clock", *KINDS)
HEARD = {"map/cells": "mapping", "map/observed": "mapping", "landing/selected": "lss"}
"""Topics by the node that publishes them."""
PATIENCE_S = 30.0
"""For the nodes to start."""


class Heard(NamedTuple):
    """What ``landing/selected`` said, and at which tick of the flight guidance heard it."""

    tick: int
    said: Target


class LiveFlight(NamedTuple):
    """A flight that has ended.

    Attributes:
        flown: As in lock-step.
        heard: Every answer, with which the flight can be flown again without ROS.
        seconds: Of real time it took.
    """

    flown: Flown
    heard: tuple[Heard, ...]
    seconds: float


def fly_live(
    seed: int,
    settings: FlightSettings,
    folder: Path,
    *,
    rate: float = 1.0,
    progress: Callable[[float], None] | None = None,
    domain: int | None = None,
) -> LiveFlight:
    """Starts both nodes, flies with them, and ends them.

    Args:
        seed, settings: As of ``flight.fly.flown``; the avoidance must be one by the nodes.
        folder: For parameters, checkpoint and the nodes' output.
        rate: Seconds of flight per second; where the computer is slower, so is ``/clock``.
        progress: Told the seconds flown, now and then.
        domain: ROS domain; None takes a free one.

    Nodes that end are started again (``restarts``). Where others published what we do, the outcome
    is ``disturbed``, and ``others`` says who.

    Raises:
        PlayError: the nodes did not start in time.
        ProcessError: a node is not installed or ended at its start, or others are in the domain.
    """
    flight = Flight(seed, settings)
    config = flight_config(settings, flight.ground)
    folder.mkdir(parents=True, exist_ok=True)
    params, checkpoint = folder / "params.yaml", folder / "checkpoint.npz"
    params.write_text(dump_config(config), encoding="utf-8")
    checkpoint.unlink(missing_ok=True)
    args = ["--params-file", str(params), "-p", "use_sim_time:=true"]
    args += ["-p", "qos.scan_reliability:=reliable", "-p", f"checkpoint.path:={checkpoint}"]
    with ExitStack() as stack:
        local = stack.enter_context(local_domain(folder, domain))
        starts = {"mapping": 0, "lss": 0}

        def start(name: str) -> NodeProcess:
            starts[name] += 1
            log = folder / (f"{name}.txt" if starts[name] == 1 else f"{name}_{starts[name]}.txt")
            return stack.enter_context(NodeProcess(f"{name}_node", args, local.env, log))

        link = stack.enter_context(_Link(local.number, config.frames.map))
        refuse_company(link.node, dict.fromkeys(SPOKEN, 1) | dict.fromkeys(HEARD, 0))
        nodes = {name: start(name) for name in starts}
        try:
            link.wait(PATIENCE_S)
        except PlayError:
            for node in nodes.values():
                node.check()
            raise
        began = time.monotonic()
        down: set[str] = set()
        asked = False
        others: set[str] = set()
        while not flight.outcome:
            for sent in flight.step():
                link.send(sent)
            for said in link.spin(flight.stamp_ns, began + flight.time / rate):
                link.heard.append(Heard(round(flight.time / TICK), said))
                flight.hear(said)
            if LAND_NOW in flight.active and not asked:
                asked = True
                link.land_now.call_async(Trigger.Request())
            for kind, name in changed(flight, down):
                if kind not in down:
                    nodes[name] = start(name)
                    continue
                nodes[name].process.kill()
                nodes[name].process.wait()
                if kind == "forget_mapping":
                    checkpoint.unlink(missing_ok=True)
            if not down and round(flight.time / TICK) % 100 == 0:
                for name, node in nodes.items():
                    if node.process.poll() is not None:
                        nodes[name] = start(name)
                # Of a node that was killed its topics are told of for a while.
                heard = {topic: starts[name] for topic, name in HEARD.items()}
                others |= {*strangers(link.node, dict.fromkeys(SPOKEN, 1) | heard)}
                if progress is not None:
                    progress(flight.time)
        seconds = time.monotonic() - began
    cells = link.map and map_from_messages(*link.map)
    last = cells and LandingSiteSelector(config).assess(cells)
    figures = figures_of(seed, flight, last)
    figures |= {"restarts": sum(starts.values()) - len(starts), "others": sorted(others)}
    if others:
        figures["outcome"] = "disturbed"
    return LiveFlight(Flown(flight, figures, last, cells), tuple(link.heard), seconds)


class _Link:
    """Publishes what a flight sends, and hears ``landing/selected``."""

    def __init__(self, domain: int, frame: str) -> None:
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = Node("flight", context=self._context)
        self._make = Messages(TYPES, packed, frame)
        self._clock = self.node.create_publisher(Clock, "/clock", stream(10, reliable=True))
        self._publishers = {
            topic: self.node.create_publisher(
                TYPES[kind],
                topic,
                latched() if topic.startswith("landing/") else stream(200, reliable=True),
            )
            for topic, kind in KINDS.items()
        }
        self.land_now = self.node.create_client(Trigger, "lss_node/land_now")
        self._said: list[Target] = []
        self.heard: list[Heard] = []
        kind, effect = TYPES[TOPIC_TYPES["landing/selected"]], "targets of either are flown to"
        problems, name = Problems(self.node.get_logger()), "/landing/selected"
        publishers = Publishers(name, "target_publishers", effect, problems)
        subscribe(self.node, kind, name, self._hear, latched(), publishers.changed)
        self.map: tuple[Any, Any] | None = None
        self._halves: dict[str, Any] = {}
        for topic in ("map/cells", "map/observed"):
            keep = functools.partial(self._keep, topic)
            self.node.create_subscription(TYPES[TOPIC_TYPES[topic]], topic, keep, latched())
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    def __enter__(self) -> _Link:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._context.try_shutdown()

    def wait(self, patience: float) -> None:
        """Until both nodes listen; says that there is no keep-out, for which lss_node waits."""
        wait_for_subscribers(self.node, list(self._publishers.values()), patience)
        self.send(Sent("landing/keep_out", START_NS, np.zeros((0, 2))))

    def send(self, sent: Sent) -> None:
        """One message."""
        self._publishers[sent.topic].publish(sent.message(self._make))

    def spin(self, stamp_ns: int, until: float) -> list[Target]:
        """Tells the time and hears answers until a moment of the steady clock."""
        self._clock.publish(Clock(clock=time_message(stamp_ns)))
        self._executor.spin_once(timeout_sec=0.0)
        while (left := until - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left)
        said, self._said = self._said, []
        return said

    def _keep(self, topic: str, message: Any) -> None:
        """The newest map, whose halves have one stamp."""
        self._halves[topic] = message
        stamps = [half.header.stamp for half in self._halves.values()]
        if len(stamps) == 2 and stamps[0] == stamps[1]:
            self.map = (self._halves["map/cells"], self._halves["map/observed"])

    def _hear(self, message: Any) -> None:
        place = message.pose.pose.position
        known = not math.isnan(place.x)
        self._said.append(Target(np.array([place.x, place.y, place.z]) if known else None))
