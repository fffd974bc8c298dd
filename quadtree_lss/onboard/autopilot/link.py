# SPDX-License-Identifier: Apache-2.0
"""MAVLink connection to ArduPilot and PX4."""

from __future__ import annotations

import os
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import pairwise
from typing import Any

import numpy as np

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.autopilot.frames import (
    FRD_TO_FLU,
    Nav,
    RemoteClock,
    attitude,
    body_frd,
    covariance_enu,
    enu,
)
from quadtree_lss.onboard.config.settings import ConfigError
from quadtree_lss.onboard.core.geometry.bounds import MAX_HEIGHT
from quadtree_lss.onboard.core.geometry.rotations import rotation_from_quaternion
from quadtree_lss.onboard.errors import QuadtreeLssError

ARDUPILOT, PX4 = 3, 12
"""Values of MAV_AUTOPILOT."""
GUIDED_MODES = {ARDUPILOT: 4, PX4: 6 << 16}
"""Custom modes that follow set-points: guided, offboard."""
ARDUPILOT_LAND = 9
"""Custom mode in which ArduPilot on the ground stops its motors; PX4 needs none."""
COPTERS = (2, 3, 4, 13, 14, 15, 29, 35)
"""Values of MAV_TYPE of multicopters and helicopters; other types number their modes differently.
"""
ARMED, CUSTOM_MODE, ON_GROUND, TAKING_OFF = 128, 1, 1, 3
DO_SET_MODE, SET_INTERVAL, ARM_DISARM = 176, 511, 400
HEARTBEAT, ATTITUDE, POSITION, EXTENDED, ODOMETRY = 0, 31, 32, 245, 331
STREAMS = {ARDUPILOT: (POSITION, ATTITUDE), PX4: (ODOMETRY,)}
POSE_HZ, STATE_HZ = 50.0, 5.0
POSITION_MASK = 0b0000_1101_1111_1000
"""Type mask of a position set-point: velocity, acceleration, yaw and yaw rate are ignored."""
POSITION_SINK_MASK = POSITION_MASK ^ 0b10_0000
"""The same with a downward speed, which PX4 needs to detect the ground."""
LOCAL_NED, BODY_FRD = 1, 12
PEER_S = 5.0
"""Silence after which an autopilot is accepted from a new address."""
MAX_MESSAGES, POLL_S = 200, 0.02
"""Limits of one call of `Link.poll`: messages and CPU time, s. An autopilot sends about 120
messages per second, and the caller polls 100 times per second."""
READ_BYTES, MAX_DROPPED_READS, PROBE_BYTES = 65536, 2000, 600
"""Size of one read; reads that one call drops beyond its limits; first bytes of a datagram in which
a heartbeat identifies a new peer as an autopilot."""
LANDED_STATE_S = 2.5
"""Maximum age of EXTENDED_SYS_STATE, which is requested five times per second."""
BAUD = 921600
"""Default rate of a serial device, baud."""
ONBOARD_COMPUTER, SEVERITY = 191, {True: 4, False: 6}
TIMESYNC_PERIOD_S, HEARTBEAT_PERIOD_S, REQUEST_PERIOD_S = 0.2, 1.0, 2.0
TEXT_LENGTH = 50
"""Characters of one STATUSTEXT."""
DAMAGED = -1
"""Message id that pymavlink gives to bytes that are not a message."""
REJECT_REASONS = frozenset("damaged clock position velocity attitude stamp order".split())
"""Keys of rejected messages; ``clock``: the offset of the autopilot's clock is not known yet."""
IGNORED = "passed_over"
STAMP_LIMIT_NS = 2**31 * 10**9
"""End of the range of ROS stamps."""


def dialect() -> Any:
    """Import pymavlink with MAVLink 2. Raises `ConfigError` if it is not installed."""
    os.environ["MAVLINK20"] = "1"
    try:
        from pymavlink import mavutil
    except ImportError:
        msg = "autopilot_node needs pymavlink: pip install pymavlink pyserial"
        raise ConfigError(msg) from None
    return mavutil


class Link:
    """Connection to one autopilot: the first whose heartbeat arrives. With UDP only its address is
    received from and sent to, until it has been silent for `PEER_S`.

    ``connection`` is ``autopilot.connection``; ``clock`` gives the time of this computer for the
    stamps of poses, ns, and ``now`` a steady time for periods and ages, s. Raises `ConfigError` if
    pymavlink is not installed or ``connection`` is invalid, `QuadtreeLssError` if it cannot be
    opened at present.

    Attributes:
        kind: ``ARDUPILOT``, ``PX4`` or None before the first heartbeat.
        last_heartbeat, last_answer: Times of the last heartbeat and TIMESYNC answer, s.
        message_counts: Messages by content: ``pose``, ``half`` of one, ``state``, or
            ``passed_over`` (of other senders or types).
        rejected: Messages that could not be used, by reason, and reads of a dropped ``backlog``.
    """

    def __init__(
        self, connection: str, clock: Callable[[], int], now: Callable[[], float] = time.monotonic
    ) -> None:
        self._connection = connection
        self._port = self._open()
        self._clock, self._now = clock, now
        self.kind: int | None = None
        self.mode, self.armed = -1, False
        self._landed: bool | None = None
        self._landed_since = 0.0
        self._takes_off = False
        self.last_heartbeat = self.last_answer = -np.inf
        self.remote = RemoteClock()
        self.message_counts: Counter[str] = Counter()
        self.rejected: Counter[str] = Counter()
        self._system = 0
        names = ("timesync", "heartbeat", "request", "stop_motors", "connect")
        self._due = dict.fromkeys(names, 0.0)
        self._timesync_sent: deque[int] = deque(maxlen=RemoteClock.KEPT)
        self._attitudes: list[tuple[int, Array]] = []
        self._positions: list[tuple[int, Array, Array]] = []
        self._last_nav = self._last_state = -np.inf
        self._peer: Any = None
        self._last_stamp, self._text_id = 0, 0

    @property
    def accepts_set_points(self) -> bool:
        """Whether it flies to set-points by its mode, and is not taking off in that: ArduCopter
        would break off."""
        follows = self.kind is not None and self.mode == GUIDED_MODES[self.kind]
        return follows and not self._takes_off

    @property
    def landed(self) -> bool | None:
        """The autopilot reports that it is on the ground; None without a recent report."""
        return self._landed if self._now() - self._last_state <= LANDED_STATE_S else None

    @property
    def landed_for(self) -> float:
        """Time since ``landed`` changed, s."""
        return self._now() - self._landed_since

    def _open(self) -> Any:
        mavutil = dialect()
        device, _, rate = self._connection.partition(",")
        # Most autopilots have system id 1; 255 is a ground station's.
        options = {"source_component": ONBOARD_COMPUTER, "source_system": 1, "autoreconnect": True}
        try:
            options |= {"baud": int(rate or BAUD), "retries": 1}  # pymavlink sleeps before retries
            port = mavutil.mavlink_connection(device, **options)
            if hasattr(port, "baud"):  # a serial device
                port.port.exclusive = True
                port.write = self._write
            elif hasattr(port, "destination_addr") and hasattr(port, "udp_server"):
                port.port.connect(port.destination_addr)  # receive from this address only
        except (OSError, ValueError, OverflowError, IndexError, ImportError) as error:
            msg = f"autopilot.connection = {self._connection!r} cannot be opened: {error}"
            may_recover = isinstance(error, OSError)  # the device may appear before a restart
            raise (QuadtreeLssError if may_recover else ConfigError)(msg) from None
        return port

    def close(self) -> None:
        """Close the connection."""
        with suppress(AttributeError):  # pymavlink has no port after the loss of a TCP peer
            self._port.close()

    def poll(self) -> list[Nav]:
        """Handle received messages and send the periodic ones; return new poses, oldest first."""
        navs: list[Nav] = []
        for message in self._messages():
            result = self._handle(message)
            if isinstance(result, Nav):
                navs.append(result)
            elif result in REJECT_REASONS:
                self.rejected[result] += 1
                continue
            self.message_counts["pose" if isinstance(result, Nav) else result] += 1
        now = self._now()
        if navs:
            self._last_nav = now
        if self._is_due("heartbeat", HEARTBEAT_PERIOD_S, now):
            self._send("heartbeat", 18, 8, 0, 0, 4)  # an onboard controller, not an autopilot
        if self.kind is not None:
            if self._is_due("timesync", TIMESYNC_PERIOD_S, now):
                self._timesync_sent.append(self._clock())
                self._send("timesync", 0, self._timesync_sent[-1])
            last = min(self._last_nav, self._last_state)
            needed = now - last > 1.0 or not self._due["request"]
            if needed and self._is_due("request", REQUEST_PERIOD_S, now):
                for number in STREAMS[self.kind]:
                    self._command(SET_INTERVAL, number, 1e6 / POSE_HZ)
                for number in (EXTENDED, HEARTBEAT):
                    self._command(SET_INTERVAL, number, 1e6 / STATE_HZ)
        if self._peer is not None and now - self.last_heartbeat > PEER_S:
            self._reopen()
        return navs

    def send_set_point(self, point: Array, sink: float = 0.0) -> None:
        """Send a position set-point (3,) in the map, m; ``sink``: speed of the descent to the
        ground, m/s."""
        mask = POSITION_SINK_MASK if sink and self.kind == PX4 else POSITION_MASK
        head, speed, unused = (0, self._system, 1, LOCAL_NED, mask), (0.0, 0.0, sink), (0.0,) * 5
        self._send("set_position_target_local_ned", *head, *enu(point), *speed, *unused)

    def send_landing_target(self, place: Array, nav: Nav) -> None:
        """Send LANDING_TARGET, for the autopilot's own precision landing (mode LAND)."""
        vector, frame = enu(place), LOCAL_NED
        if self.kind == ARDUPILOT:
            vector, frame = body_frd(place - nav.position, nav.quaternion), BODY_FRD
        offset = self.remote.offset_ns or 0
        stamp_us = max(nav.stamp_ns - offset, 0) // 1000
        distance = float(np.linalg.norm(place - nav.position))
        angles, level = (0.0, 0.0, distance, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
        self._send("landing_target", stamp_us, 0, frame, *angles, *vector, level, 3, 1)

    def request_guided_mode(self) -> None:
        """Request the mode that follows set-points."""
        if self.kind is not None:
            self._set_mode(GUIDED_MODES[self.kind])

    def stop_motors(self, *, disarm: bool) -> None:
        """Request land mode on the ground if that stops the motors, or disarm; at most once per
        second, so call it until the motors have stopped."""
        if not self._is_due("stop_motors", HEARTBEAT_PERIOD_S, self._now()):
            return
        if disarm:
            self._command(ARM_DISARM, 0.0)
        elif self.kind == ARDUPILOT:
            self._set_mode(ARDUPILOT_LAND)

    def send_text(self, text: str, *, warn: bool) -> None:
        """Send a line to the ground station, as one or more STATUSTEXT."""
        line, self._text_id = text.encode("ascii", "replace"), self._text_id % 0xFFFF + 1
        pieces = range(0, len(line) + 1, TEXT_LENGTH) if len(line) > TEXT_LENGTH else (0,)
        for number, begin in enumerate(pieces):  # a piece that is not full is the last
            piece, whole = line[begin : begin + TEXT_LENGTH], len(pieces) == 1
            self._send("statustext", SEVERITY[warn], piece, 0 if whole else self._text_id, number)

    def _set_mode(self, mode: int) -> None:
        parts = (mode >> 16 & 0xFF, mode >> 24) if self.kind == PX4 else (mode,)
        self._command(DO_SET_MODE, CUSTOM_MODE, *parts)

    def _command(self, command: int, *values: float) -> None:
        padded = [*values, *[0.0] * (7 - len(values))]
        self._send("command_long", self._system, 1, command, 0, *padded)

    def _send(self, name: str, *values: Any) -> None:
        """Send a message; a lost connection shows in the age of the heartbeats."""
        with suppress(OSError):
            if not self._is_disconnected():
                getattr(self._port.mav, f"{name}_send")(*values)

    def _write(self, content: bytes) -> None:
        """Write to a serial device without blocking, which pyserial would do."""
        try:
            os.write(self._port.fd, content)
        except BlockingIOError:
            return
        except OSError:  # unplugged
            self._port.reset()

    def _is_disconnected(self) -> bool:
        """Whether the TCP peer is lost and the next attempt to connect is not due."""
        lost = getattr(self._port, "port", 0) is None
        return lost and not self._is_due("connect", REQUEST_PERIOD_S, self._now())

    def _is_due(self, what: str, period: float, now: float) -> bool:
        if 0.0 < self._due[what] - now <= period:  # longer after a simulator's restart
            return False
        self._due[what] = now + period
        return True

    def _messages(self) -> Iterator[Any]:
        """Yield received messages within the limits of one call; drop the rest."""
        end, count, parse = time.thread_time() + POLL_S, 0, self._port.mav.parse_char
        while (piece := self._read()) is not None:
            message = parse(piece)
            while message is not None:
                yield message
                count += 1
                message = parse(b"") if count < MAX_MESSAGES else None
            if count >= MAX_MESSAGES or time.thread_time() > end:
                self._drop_backlog()
                return

    def _drop_backlog(self) -> None:
        self._port.mav.buf, self._port.mav.buf_index = bytearray(), 0
        for _ in range(MAX_DROPPED_READS):
            if self._read() is None:
                break
            self.rejected["backlog"] += 1

    def _read(self) -> bytes | None:
        """Return received bytes, empty if another peer sent them; None if there are no more."""
        with suppress(OSError):
            if self._is_disconnected():
                return None
            if not getattr(self._port, "udp_server", False):
                return self._port.recv(READ_BYTES) or None
            piece, address = self._port.port.recvfrom(READ_BYTES)
            if self._peer is None and self._is_from_autopilot(piece):
                self._peer, self._port.clients = address, {address}
                self._port.port.connect(address)  # the kernel queues only this peer's datagrams
            if address == self._peer:
                return bytes(piece)
            self.message_counts[IGNORED] += 1
            return b""
        return None

    def _is_from_autopilot(self, piece: bytes) -> bool:
        """Whether a datagram has the heartbeat of an autopilot that `_is_accepted`."""
        parser = dialect().mavlink.MAVLink(None)
        parser.robust_parsing = True
        return any(
            message.get_msgId() == HEARTBEAT and self._is_accepted(message)
            for message in parser.parse_buffer(piece[:PROBE_BYTES]) or ()
        )

    def _reopen(self) -> None:
        """Accept datagrams from every address again, because the autopilot's may have changed."""
        with suppress(QuadtreeLssError):
            self._port.close()
            self._port, self._peer = self._open(), None
            self._port.mav.srcSystem = self._system

    def _handle(self, message: Any) -> Nav | str:
        """Handle one message; return the pose that it completes, or the key that counts it."""
        number = message.get_msgId()
        if number == HEARTBEAT:
            return self._on_heartbeat(message)
        if number == DAMAGED:
            return "damaged"
        if message.get_srcSystem() != self._system or message.get_srcComponent() != 1:
            return IGNORED
        is_answer = message.get_type() == "TIMESYNC" and message.tc1 > 0
        if is_answer and message.ts1 in self._timesync_sent:
            self.remote.add(message.ts1, message.tc1, self._clock())
            self.last_answer = self._now()
            return "state"
        if number == EXTENDED:
            if message.landed_state:  # 0: undefined
                landed = message.landed_state == ON_GROUND
                if landed is not self.landed:
                    self._landed_since = self._now()
                self._landed = landed
                self._takes_off = message.landed_state == TAKING_OFF
                self._last_state = self._now()
            return "state"
        if number == ODOMETRY and message.frame_id == LOCAL_NED:
            return self._on_odometry(message)
        if number == POSITION and self.kind == ARDUPILOT:
            place = np.array([message.x, message.y, message.z])
            velocity = np.array([message.vx, message.vy, message.vz])
            self._positions = [*self._positions[-3:], (message.time_boot_ms, place, velocity)]
            return self._nav_from_pair()
        if number == ATTITUDE and self.kind == ARDUPILOT:
            q = np.array([message.q1, message.q2, message.q3, message.q4])
            self._attitudes = [*self._attitudes[-3:], (message.time_boot_ms, q)]
            return self._nav_from_pair()
        return IGNORED

    def _on_heartbeat(self, message: Any) -> str:
        if not self._is_accepted(message):
            return IGNORED
        if self.kind is None:
            self.kind, self._system = message.autopilot, message.get_srcSystem()
            self._port.mav.srcSystem = self._system
        self.last_heartbeat = self._now()
        self.mode = message.custom_mode
        self.armed = bool(message.base_mode & ARMED)
        return "state"

    def _is_accepted(self, message: Any) -> bool:
        """Whether a heartbeat is that of the connected autopilot, or of the first one."""
        supported = message.autopilot in GUIDED_MODES and message.type in COPTERS
        same = (message.autopilot, message.get_srcSystem()) == (self.kind, self._system)
        return supported and message.get_srcComponent() == 1 and (same or self.kind is None)

    def _on_odometry(self, message: Any) -> Nav | str:
        place = np.array([message.x, message.y, message.z])
        velocity = np.array([message.vx, message.vy, message.vz])
        q, upper = np.array(message.q), np.array(message.pose_covariance)
        in_body = message.child_frame_id != LOCAL_NED  # PX4 sends the velocity in NED
        return self._nav(1000 * message.time_usec, place, q, velocity, upper, in_body=in_body)

    @np.errstate(invalid="ignore")  # `_nav` checks the values
    def _nav_from_pair(self) -> Nav | str:
        """Combine a position with the attitude interpolated at its time."""
        for time_ms, place, velocity in reversed(self._positions):
            for (before, q0), (after, q1) in pairwise(self._attitudes):
                if before <= time_ms <= after and after - before < 200:
                    self._positions = [row for row in self._positions if row[0] > time_ms]
                    share = (time_ms - before) / max(after - before, 1)
                    q = (1.0 - share) * q0 + share * (q1 if q0 @ q1 >= 0.0 else -q1)
                    return self._nav(time_ms * 1_000_000, place, q, velocity, None, in_body=False)
        return "half"

    def _nav(
        self, own_ns: int, place: Array, q: Array, velocity: Array, upper: Array | None,
        *, in_body: bool,
    ) -> Nav | str:  # fmt: skip
        """Convert a pose to this computer's clock and the map; return a key of `REJECT_REASONS` if
        it is invalid. ``in_body``: the velocity is in body axes."""
        offset, length = self.remote.offset_ns, float(np.linalg.norm(q))
        if offset is None:
            return "clock"
        stamp = own_ns + offset
        checks = {
            "position": (np.abs(place) <= MAX_HEIGHT).all(),
            "velocity": (np.abs(velocity) <= MAX_HEIGHT).all(),
            "attitude": abs(length - 1.0) < 0.05,
            "stamp": 0 <= stamp < STAMP_LIMIT_NS,
            "order": not 0 <= self._last_stamp - stamp < 1_000_000_000,  # after a change of offset
        }
        for reason, is_valid in checks.items():
            if not is_valid:
                return reason
        self._last_stamp = stamp
        quaternion = attitude(q / length)
        if in_body:
            velocity = rotation_from_quaternion(quaternion) @ (velocity * FRD_TO_FLU)
        else:
            velocity = enu(velocity)
        covariance = None if upper is None else covariance_enu(upper, quaternion)
        return Nav(stamp, enu(place), quaternion, velocity, covariance, own_ns)
