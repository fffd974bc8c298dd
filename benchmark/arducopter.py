# SPDX-License-Identifier: Apache-2.0
"""Landings with ArduCopter, software in the loop: all three nodes as processes, over DDS.

``ARDUCOPTER`` names the binary; without it nothing is flown. A pilot takes off, hovers and switches
to guided; autopilot_node lands. Scans are simulated from the true position over rocky ground, with
the drone preset, and the touchdown is evaluated on that ground. (The ground of the simulator is the
plane of the median height of the field.) A bridge between the simulator and autopilot_node drops,
delays or cuts messages as a fault requires. All nodes use the time of the simulator on /clock.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import machine, table
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PolygonStamped, PoseWithCovarianceStamped
from rosgraph_msgs.msg import Clock
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2

from quadtree_lss.desk.replay.configuration import dump_config, load_config
from quadtree_lss.lab.campaign.study import this_build
from quadtree_lss.lab.live.listener import Listener
from quadtree_lss.lab.live.processes import NodeProcess, ProcessError, local_domain
from quadtree_lss.lab.simulation.lidar import FlashLidar
from quadtree_lss.lab.simulation.recording import Messages
from quadtree_lss.lab.simulation.safety import contact_safe, worst_contact
from quadtree_lss.lab.simulation.scenarios import SCENARIOS, Conditions
from quadtree_lss.lab.simulation.terrain import Terrain
from quadtree_lss.onboard.autopilot.landing import WAIT_LIMIT_S
from quadtree_lss.onboard.autopilot.link import ARM_DISARM, ARMED, CUSTOM_MODE, DO_SET_MODE, dialect
from quadtree_lss.onboard.nodes.qos import latched, stream
from quadtree_lss.onboard.nodes.ros_messages import TYPES, packed, time_message

CONFIG = Path(__file__).parents[1] / "config"
LOITER, GUIDED = 5, 4
HOME, RADIUS_M = (-35.363262, 149.165237, 584.0), 6_378_100.0
HEIGHT_M, SCAN_S = 18.0, 0.2
MAX_DISTANCE_M, MAX_LANDING_S, MAX_START_S, MAX_WALL_START_S = 25.0, 150.0, 120.0, 400.0
STEPS_HZ, BEGAN_S = 800, 1_700_000_000
BACKLOG = 40  # unread true positions from which the computer counts as too slow
POSES = ("LOCAL_POSITION_NED", "ATTITUDE_QUATERNION", "ODOMETRY")
NODES = ("mapping_node", "lss_node", "autopilot_node")
SIMULATOR_PARAMETERS = {
    "FRAME_CLASS": 1, "LOG_BACKEND_TYPE": 0, "BATT_MONITOR": 4, "EK3_IMU_MASK": 1,
    **{f"COMPASS_OFS{n}_{a}": v for n in ("", 2, 3) for a, v in (("X", 5), ("Y", 13), ("Z", -18))},
    **{f"INS_ACC{n}OFFS_{a}": 0.001 for n in ("", 2) for a in "XYZ"},
    **{f"INS_ACC{n}SCAL_{a}": 1.001 for n in ("", 2) for a in "XYZ"},
}  # fmt: skip
"""Calibration of the sensor errors of the simulator."""


class Copter:
    """The binary with a pilot at its radio, a ground station and a bridge to autopilot_node.

    Attributes:
        port: Port for autopilot_node.
        mode, armed: State in the last heartbeat.
        cut, lost, delay: State of the bridge: it drops all messages; it drops poses; delay of
            poses, s.
        now: Time of the simulator, s.
        behind: The computer is too slow: the last true position is older than ``now``.
    """

    NAME = "ArduCopter"
    #: The mode in which it follows set-points.
    GUIDED_MODE = GUIDED

    def __init__(
        self, binary: str, folder: Path, heading: float, tell: Callable[[float], None]
    ) -> None:
        self.port = _free_port()
        self._node = dialect().mavlink_connection(f"udpout:127.0.0.1:{self.port}")
        self._system, self.mode, self.armed = 1, -1, False
        self._values: dict[str, float] = {}
        self.cut, self.lost, self.delay = False, False, 0.0
        self.behind = False
        self.now, self._boot_time, self._steps, self._clocked = 0.0, 0.0, 0, 0.0
        self._publish_clock = tell
        self._delayed: list[tuple[float, bytes]] = []
        self._true_state: tuple[float, tuple[float, ...]] = (0.0, (math.nan,) * 6)
        self._sticks = [1500, 1500, 1000, 1500]
        with (folder / "autopilot.txt").open("wb") as output:
            self.process = self._launch(binary, folder, heading, output)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run_bridge, daemon=True)

    def _launch(
        self, binary: str, folder: Path, heading: float, output: BinaryIO
    ) -> subprocess.Popen[bytes]:
        mavutil = dialect()
        # Below the ports of ROS domains.
        for instance in map(int, np.random.default_rng().permutation(np.arange(10, 180))):
            try:
                with bound(5501 + 10 * instance):
                    self._truth = bound(5503 + 10 * instance)
                break
            except OSError:
                continue
        self._truth.setblocking(False)
        ground, own = _free_port(), _free_port()
        self._ground = mavutil.mavlink_connection(f"udpin:127.0.0.1:{ground}", source_system=255)
        self._own = mavutil.mavlink_connection(f"udpin:127.0.0.1:{own}")
        self._radio = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._radio.connect(("127.0.0.1", 5501 + 10 * instance))
        lines = [f"{name} {value}" for name, value in SIMULATOR_PARAMETERS.items()]
        given = (CONFIG / "ardupilot.parm").read_text("utf-8").splitlines()
        lines += [line for line in given if not line.startswith("#")]
        (folder / "bench.parm").write_text("\n".join(lines) + "\n", encoding="utf-8")
        home = ",".join(map(str, (*HOME, heading)))
        return subprocess.Popen(
            [
                binary, "--model", "quad", "--home", home, "--enable-fgview", "--wipe",
                "--rate", str(STEPS_HZ), "--speedup", "10",
                "-I", str(instance), "--defaults", "bench.parm",
                "--serial0", f"udpclient:127.0.0.1:{ground}",
                "--serial2", f"udpclient:127.0.0.1:{own}",
            ],
            cwd=folder, stdout=output, stderr=subprocess.STDOUT,
        )  # fmt: skip

    def __enter__(self) -> Copter:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join(5.0)
        self.process.kill()
        self.process.wait()
        for port in (self._ground, self._own, self._node, self._truth):
            port.close()

    def truth(self) -> tuple[float, np.ndarray, np.ndarray]:
        """Time, s; position (3,) east, north, up of home, m; rotation from FRD to these axes."""
        at, (longitude, latitude, height, *turn) = self._true_state
        north = RADIUS_M * (latitude - math.radians(HOME[0]))
        east = RADIUS_M * (longitude - math.radians(HOME[1])) * math.cos(math.radians(HOME[0]))
        swap = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
        ned = Rotation.from_euler("ZYX", turn[::-1]).as_matrix()
        return at, np.array([east, north, height - HOME[2]]), swap @ ned

    def set(self, name: str, value: float) -> None:
        """Set a parameter until the autopilot confirms it. Raises `TimeoutError`: it never does."""
        for _ in range(300):
            self._ground.mav.param_set_send(self._system, 1, name.encode(), value, 9)
            time.sleep(0.1)
            if math.isclose(self._values.get(name, math.nan), value, rel_tol=1e-5, abs_tol=1e-9):
                return
        raise TimeoutError(name)

    def command(self, number: int, *values: float) -> None:
        """Send a command of the pilot."""
        values = *values, *[0.0] * (7 - len(values))
        self._ground.mav.command_long_send(self._system, 1, number, 0, *values)

    def start(self) -> None:
        """Arm."""
        self.switch_to_pilot()
        self.command(ARM_DISARM, 1.0)

    def take_off(self) -> None:
        """Take off; soon after `start`, because the autopilot disarms otherwise."""
        self._sticks[2] = 1900

    def hover(self) -> None:
        """Hover."""
        self._sticks[2] = 1500

    def switch_to_guided(self) -> None:
        """Switch to the mode that follows set-points."""
        self._switch(self.GUIDED_MODE)

    def switch_to_pilot(self) -> None:
        """Switch to the pilot's mode."""
        self._switch(LOITER)

    def pace(self, seconds: float) -> None:
        """Set the simulated seconds per second."""
        self.set("SIM_SPEEDUP", seconds)

    def wind(self, heading: float) -> None:
        """Set a wind of 8 m/s."""
        self.set("SIM_WIND_DIR", heading)
        self.set("SIM_WIND_SPD", 8.0)

    def glitch(self, off: bool) -> None:
        """Move GPS by 11 m, or back."""
        self.set("SIM_GPS1_GLTCH_X", 1e-4 * off)

    def _switch(self, mode: int) -> None:
        self.command(DO_SET_MODE, CUSTOM_MODE, mode)

    def _receive_truth(self) -> None:
        """Receive the true state and the time."""
        packet, before = b"", self._steps
        try:
            while True:
                packet = self._truth.recv(2048)
                self._steps += 1
        except OSError:
            pass
        self.behind = self._steps - before > BACKLOG
        since = self._steps / STEPS_HZ
        self.now = max(self.now, self._boot_time + min(since, 0.03) if self._boot_time else since)
        if packet:
            values = struct.unpack_from(">3d4f", packet, 8)
            self._true_state = (self.now, (*values[:3], *values[4:]))

    def _on_ground_message(self, message: Any) -> None:
        """Handle a message to the ground station."""
        if message.get_type() == "HEARTBEAT" and message.get_srcComponent() == 1:
            self.mode, self.armed = message.custom_mode, bool(message.base_mode & ARMED)
        elif message.get_type() == "PARAM_VALUE":
            self._values[message.param_id] = message.param_value

    def _send_sticks(self) -> None:
        """Send the pilot's sticks, twenty times a second."""
        self._radio.send(struct.pack("<16H", *self._sticks, *[1500] * 12))

    def _run_bridge(self) -> None:
        due = 0.0
        while not self._end.is_set():
            self._receive_truth()
            now = self.now
            if now - self._clocked > 0.01 and self.armed:
                self._clocked = now
                self._publish_clock(now)
            while (message := self._ground.recv_msg()) is not None:
                self._on_ground_message(message)
            while (message := self._own.recv_msg()) is not None:
                pose = message.get_type() in POSES
                if hasattr(message, "time_boot_ms") and pose:
                    self._boot_time, self._steps = 1e-3 * message.time_boot_ms, 0
                if not self.cut and not (pose and self.lost):
                    self._delayed.append((now + pose * self.delay, bytes(message.get_msgbuf())))
            self._delayed.sort(key=lambda one: one[0])
            while self._delayed and self._delayed[0][0] <= now:
                _send(self._node, self._delayed.pop(0)[1])
            while (message := self._node.recv_msg()) is not None:
                if not self.cut:
                    _send(self._own, bytes(message.get_msgbuf()))
            if time.monotonic() > due:
                with suppress(OSError):  # the simulator has ended
                    self._send_sticks()
                due = time.monotonic() + 0.05
            time.sleep(0.002)


def _stamp(now: float) -> int:
    return BEGAN_S * 10**9 + round(1e9 * now)


def _send(port: Any, data: bytes) -> None:
    try:
        port.write(data)
    except OSError:
        return


def bound(port: int) -> socket.socket:
    """A UDP socket at a local port. Raises `OSError`: the port is in use."""
    found = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        found.bind(("127.0.0.1", port))
    except OSError:
        found.close()
        raise
    return found


def _free_port() -> int:
    with bound(0) as probe:
        return int(probe.getsockname()[1])


@dataclass
class Landing:
    """Outcome of a flight.

    Attributes:
        outcome: landed, hovered, given to the pilot, flew away, no target (the pilot did not switch
            to guided), no start, or broken off.
        ground: Ground of a landing: safe, unsafe or withdrawn.
        miss: True distance from the last target, m.
        place: Position east and north, m, slope, deg, and rise, m, of a landing.
        height: Height over the target at which the fault began, m; NaN if it did not.
        seconds: Simulated duration of the landing; ``pace``: simulated per real second.
        states: States of autopilot_node, in order.
        build: Build of the package.
    """

    seed: int
    fault: str
    outcome: str = ""
    ground: str = ""
    miss: float = math.nan
    place: list[float] = field(default_factory=list)
    pace: float = math.nan
    height: float = math.nan
    seconds: float = 0.0
    states: list[str] = field(default_factory=list)
    build: str = field(default_factory=lambda: this_build()[1])

    def __str__(self) -> str:
        miss = "" if math.isnan(self.miss) else f", {self.miss:.2f} m from the target"
        where = f" on {self.ground} ground{miss}" if self.ground else ""
        way = " ".join(self.states)
        pace = f", pace {self.pace:.2f}"
        pace += ", the fault never came" if self.fault and math.isnan(self.height) else ""
        return f"{self.seed} {self.fault or 'nominal'}: {self.outcome}{where}{pace} ({way})"


class Flight:
    """One landing of a seed."""

    def __init__(
        self,
        binary: str,
        seed: int,
        fault: str,
        folder: Path,
        pace: float = 1.0,
        kind: type[Copter] = Copter,
    ) -> None:
        self.landing, self._folder, self._pace = Landing(seed, fault), folder, pace
        self._kind = kind
        self._generator = np.random.default_rng(seed)
        made = Conditions().ground("drone", self._generator)
        self.terrain = Terrain(made.x, made.y, made.elevation - np.median(made.elevation))
        self._lidar = FlashLidar(60.0, pixels=120, range_noise=0.02)
        self._height = float(self._generator.uniform(1.0, 7.0))  # of the begin of the fault
        self._cut_duration = float(self._generator.uniform(1.0, 10.0))
        self._binary, self._heading = binary, float(self._generator.uniform(0.0, 360.0))
        self._fault_ends: list[tuple[float, Callable[[], object]]] = []
        self._keep_out: np.ndarray | None = None
        self._target = np.full(3, np.nan)

    def fly(self) -> Landing:
        """Fly from the take-off to the end of the landing."""
        with ExitStack() as stack:
            domain = stack.enter_context(local_domain(self._folder))
            topics = {
                "landing/selected": PoseWithCovarianceStamped,
                "landing/autopilot": DiagnosticStatus,
            }
            self._listener = stack.enter_context(Listener(domain, topics))
            node = self._listener.node
            self._scans = node.create_publisher(
                PointCloud2, "lidar/points", stream(5, reliable=False)
            )
            self._keep_out_publisher = node.create_publisher(
                PolygonStamped, "landing/keep_out", latched()
            )
            self._make = Messages(TYPES, packed)
            clock = node.create_publisher(Clock, "/clock", stream(10, reliable=True))
            tell = lambda now: clock.publish(Clock(clock=time_message(_stamp(now))))  # noqa: E731
            made = self._kind(self._binary, self._folder, self._heading, tell)
            self.copter = stack.enter_context(made)
            over = {
                "pose.source": "odometry",
                "mount.roll_deg": 180.0,
                "autopilot.connection": f"udpin:127.0.0.1:{self.copter.port}",
                "autopilot.may_command": "modes",
                "autopilot.reach": 15.0,
            }
            params = self._folder / "params.yaml"
            params.write_text(
                dump_config(load_config([CONFIG / "drone.yaml"], over)), encoding="utf-8"
            )
            self._args = ["--params-file", str(params), "-p", "use_sim_time:=true"]
            self._stack = stack
            self.nodes: dict[str, NodeProcess] = {}
            if self._take_off():
                self._land()
            elif not self.landing.outcome:
                self.landing.outcome = "no start"
        return self.landing

    def _start(self, name: str) -> NodeProcess:
        log = self._folder / f"{name}_{time.monotonic_ns()}.txt"
        return self._stack.enter_context(NodeProcess(name, self._args, log))

    def _publish_keep_out(self, corners: np.ndarray) -> None:
        self._keep_out_publisher.publish(self._make.polygon(_stamp(self.copter.now), corners))

    def _tick(self) -> tuple[np.ndarray, float]:
        """Publish a scan when one is due; return true position and speed since the last call."""
        due, stuck = self.copter.now + SCAN_S, time.monotonic() + 10.0
        while (self.copter.now < due or self.copter.behind) and time.monotonic() < stuck:
            if self.copter.process.poll() is not None:
                msg = "the simulator has ended"
                raise ProcessError(msg)
            time.sleep(0.01)
        at, place, turn = self.copter.truth()
        if np.isfinite(place).all() and place[2] > 0.3:
            points = self._lidar.scan(self.terrain, place, turn, self._generator)
            self._scans.publish(self._make.scan(_stamp(at), points))
        before, self._last = getattr(self, "_last", (at, place)), (at, place)
        span = max(at - before[0], 1e-3)
        state = self.state
        if state and (not self.landing.states or self.landing.states[-1] != state):
            self.landing.states.append(state)
        selected = self._listener.newest.get("landing/selected")
        if selected is not None:
            at = selected.pose.pose.position
            if not math.isnan(at.x):
                self._target = np.array([at.x, at.y, at.z])
        return place, float(np.linalg.norm(place - before[1])) / span

    @property
    def state(self) -> str:
        """The last state of autopilot_node."""
        said = self._listener.newest.get("landing/autopilot")
        return "" if said is None else {item.key: item.value for item in said.values}["state"]

    def _take_off(self) -> bool:
        """Take off in loiter, hover and switch to guided; return False if that failed."""
        copter, asked, end = self.copter, 0.0, time.monotonic() + MAX_WALL_START_S
        while copter.now < MAX_START_S and time.monotonic() < end:
            place, speed = self._tick()
            if copter.mode == copter.GUIDED_MODE:  # a heartbeat late: it may fly and sink by now
                return True
            if not copter.armed:
                if copter.now - asked > 1.0:
                    asked = copter.now
                    copter.start()
            elif not self.nodes:
                copter.take_off()
                copter.pace(self._pace)  # the start runs at the default pace
                self.nodes = {name: self._start(name) for name in NODES}
                self._publish_keep_out(np.zeros((0, 2)))
            elif place[2] < HEIGHT_M - 1.5:
                copter.take_off()
            else:
                copter.hover()
                if self.landing.fault == "wind of 8 m/s":
                    copter.wind(self._heading)
                if speed < 0.3 and np.isfinite(self._target).all():
                    copter.switch_to_guided()
        if copter.armed and copter.truth()[1][2] >= HEIGHT_M - 1.5:
            self.landing.outcome = "no target"
        return False

    def _land(self) -> None:
        """Let autopilot_node land until the vehicle is on the ground or stays in place."""
        copter, landing, begun = self.copter, self.landing, self.copter.now
        home, still, failed = copter.truth()[1], begun, False
        farthest, wall = 0.0, time.monotonic()
        while True:
            place, speed = self._tick()
            now = copter.now
            farthest = max(farthest, float(np.hypot(*(place - home)[:2])))
            if landing.fault and not failed and self.state in ("descend", "commit"):
                failed = place[2] - self._target[2] < self._height
                if failed:
                    landing.height = float(place[2] - self._target[2])
                    self._begin_fault(now)
            for due, end in list(self._fault_ends):
                if now > due:
                    end()
                    self._fault_ends.remove((due, end))
            if speed > 0.5:
                still = now
            over = failed and (self.state in ("pilot", "hold") or self.killed("autopilot_node"))
            over = (over or self.state == "give_up") and now - still > WAIT_LIMIT_S + 3.0
            if farthest > MAX_DISTANCE_M or place[2] > HEIGHT_M + 15.0:
                landing.outcome = "flew away"
            elif not copter.armed:
                landing.outcome = "landed"
                self._evaluate(place)
            elif over and not self._fault_ends:
                pilot = self.state in ("give_up", "pilot") and not self.killed("autopilot_node")
                landing.outcome = "given to the pilot" if pilot else "hovered"
            elif now - begun > MAX_LANDING_S:
                landing.outcome = "hovered" if now - still > 10.0 else "flew on"
            if landing.outcome:
                landing.seconds = now - begun
                landing.pace = landing.seconds / (time.monotonic() - wall)
                return

    def killed(self, name: str) -> bool:
        """Whether a node has ended."""
        return self.nodes[name].process.poll() is not None

    def _begin_fault(self, now: float) -> None:
        """Begin the fault; store the time and the action that end it."""
        copter, fault, bridge = self.copter, self.landing.fault, self.copter.__setattr__
        name, _, how = fault.partition(" ")
        if name in NODES:
            self.nodes[name].process.kill()
            self.nodes[name].process.wait()
            if how == "killed, back after 1 s":
                again = lambda: self.nodes.__setitem__(name, self._start(name))  # noqa: E731
                self._fault_ends.append((now + 1.0, again))
        elif fault == "poses lost for 3 s":
            copter.lost = True
            self._fault_ends.append((now + 3.0, lambda: bridge("lost", False)))
        elif fault == "poses 0.7 s late":
            copter.delay = 0.7
            self._fault_ends.append((now + 5.0, lambda: bridge("delay", 0.0)))
        elif fault == "link cut for 1 to 10 s":
            copter.cut = True
            self._fault_ends.append((now + self._cut_duration, lambda: bridge("cut", False)))
        elif fault == "keep-out over the target":
            square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
            self._keep_out = self._target[:2] + 2.0 * square
            self._publish_keep_out(self._keep_out)
        elif fault == "GPS 11 m off for 4 s":
            copter.glitch(True)
            self._fault_ends.append((now + 4.0, lambda: copter.glitch(False)))
        elif fault == "pilot takes over":
            copter.switch_to_pilot()

    def _evaluate(self, place: np.ndarray) -> None:
        """Evaluate a touchdown on the true ground, with the keep-out."""
        terrain, landing = self.terrain, self.landing
        gear = SCENARIOS["drone"].lander
        spot = place[None, :2]
        slope, rise = (one[0] for one in worst_contact(terrain, spot, gear))
        landing.place = [*map(float, spot[0]), math.degrees(math.atan(slope)), float(rise)]
        landing.ground = "safe" if contact_safe(terrain, spot, gear)[0] else "unsafe"
        if self._keep_out is not None:
            beside = np.abs(place[:2] - self._keep_out.mean(axis=0)).max()
            landing.ground = "withdrawn" if beside < 2.0 else landing.ground
        landing.miss = float(np.hypot(*(place - self._target)[:2]))


FAULTS = (
    *(f"{name} killed" for name in NODES),
    *(f"{name} killed, back after 1 s" for name in NODES[:2]),
    "poses lost for 3 s",
    "poses 0.7 s late",
    "link cut for 1 to 10 s",
    "keep-out over the target",
    "GPS 11 m off for 4 s",
    "wind of 8 m/s",
    "pilot takes over",
)


def fly(case: tuple[str, int, str, float, type[Copter]]) -> Landing:
    """Fly one case."""
    binary, seed, fault, pace, kind = case
    with tempfile.TemporaryDirectory() as scratch:
        flight = Flight(binary, seed, fault, Path(scratch), pace, kind)
        try:
            return flight.fly()
        except (ProcessError, TimeoutError) as error:  # the other flights continue
            flight.landing.outcome = f"broken off, {error}"
            return flight.landing


HEADER = ["", "flights", "safe landings", "unsafe", "hover or pilot", "no target"]
HEADER += ["flew away", "no start or broken off", "greatest miss, m"]


def row(name: str, some: list[Landing]) -> list[object]:
    """Numbers of flights with the same outcome, in the order of `HEADER`."""
    ends, grounds = (Counter(getattr(one, of) for one in some) for of in ("outcome", "ground"))
    misses = [one.miss for one in some if one.outcome == "landed"]
    failed = ("no start", "broken off")
    return [
        name, len(some), grounds["safe"], grounds["unsafe"] + grounds["withdrawn"],
        ends["hovered"] + ends["given to the pilot"], ends["no target"],
        ends["flew away"] + ends["flew on"], sum(one.outcome.startswith(failed) for one in some),
        f"{max(misses):.2f}" if misses else "-",
    ]  # fmt: skip


def main(
    args: Sequence[str] | None = None,
    kind: type[Copter] = Copter,
    variable: str = "ARDUCOPTER",
    known: Sequence[str] = FAULTS,
) -> int:
    """Fly and print the table; return 3 if a landing was unsafe or a vehicle flew away."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--landings", type=int, default=200, help="without a fault")
    parser.add_argument("--faults", type=int, default=60, help="landings with one")
    parser.add_argument("--seed", type=int, default=71000, help="of the first")
    parser.add_argument("--jobs", type=int, default=1, help="flights at once")
    text = "seconds of the simulator for one: less than 1 where nodes cannot keep up"
    parser.add_argument("--pace", type=float, default=1.0, help=text)
    text = "file of flights, a line each: those of this build are not flown again"
    parser.add_argument("--records", type=Path, help=text)
    given = parser.parse_args(args)
    binary = os.environ.get(variable, "")
    if not binary:
        print(f"nothing flown: {variable} names no software-in-the-loop binary; {machine()}")
        return 0
    faults = [known[k % len(known)] for k in range(given.faults)]
    names = [*[""] * given.landings, *faults]
    cases = [(binary, given.seed + k, f, given.pace, kind) for k, f in enumerate(names)]
    found: list[Landing] = []
    if given.records and given.records.exists():
        known_cases = {(seed, name) for _, seed, name, *_ in cases}
        lines = given.records.read_text("utf-8").splitlines()
        found = [Landing(**json.loads(line)) for line in lines]
        found = [one for one in found if (one.seed, one.fault) in known_cases]
        found = [one for one in found if one.build == this_build()[1]]
    flown = {one.seed for one in found}
    if given.records:
        given.records.parent.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(given.jobs) as pool:
        try:
            for landing in pool.map(fly, [one for one in cases if one[1] not in flown]):
                print(landing, file=sys.stderr)
                found.append(landing)
                if given.records:
                    with given.records.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(asdict(landing)) + "\n")
        except KeyboardInterrupt:
            pool.shutdown(cancel_futures=True)
    parts = {"no fault": [one for one in found if not one.fault]}
    parts["a fault"] = [one for one in found if one.fault]
    rows = [row(name, some) for name, some in parts.items() if some]
    table(kind.NAME, HEADER, rows)
    print(machine())
    bad = [one for one in found if one.outcome in ("flew away", "flew on")]
    bad += [one for one in found if one.ground in ("unsafe", "withdrawn")]
    return 3 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
