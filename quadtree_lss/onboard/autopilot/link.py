# SPDX-License-Identifier: Apache-2.0
"""MAVLink to ArduPilot and PX4: what is heard of the vehicle, and the few things that are said."""

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
"""MAV_AUTOPILOT of a heartbeat."""
FOLLOWS = {ARDUPILOT: 4, PX4: 6 << 16}
"""Custom mode in which set-points are followed: guided, offboard."""
LAND = {ARDUPILOT: 9}
"""Custom mode in which an autopilot on the ground stops its motors; PX4 needs none."""
COPTERS = (2, 3, 4, 13, 14, 15, 29, 35)
"""MAV_TYPE of what hovers: the modes of others have other numbers."""
ARMED, CUSTOM_MODE, ON_GROUND, TAKING_OFF = 128, 1, 1, 3
DO_SET_MODE, SET_INTERVAL, ARM_DISARM = 176, 511, 400
HEARTBEAT, ATTITUDE, POSITION, EXTENDED, ODOMETRY = 0, 31, 32, 245, 331
STREAMS = {ARDUPILOT: (POSITION, ATTITUDE), PX4: (ODOMETRY,)}
POSE_HZ, STATE_HZ = 50.0, 5.0
PLACE_ALONE = 0b0000_1101_1111_1000
"""Type mask of a set-point that is a place: no velocity, acceleration, yaw or rate of it."""
SINKS = PLACE_ALONE ^ 0b10_0000
"""The same with a speed down, without which PX4 does not look for the ground."""
LOCAL_NED, BODY_FRD = 1, 12
PEER_S = 5.0
"""An autopilot that was silent for longer may speak from another address."""
MOST_MESSAGES, POLL_S = 200, 0.02
"""One call of `Link.poll` takes no more messages, and works no longer: both autopilots send some
120 messages in a second, and it is called a hundred times."""
PIECE, MOST_PIECES, TELLS = 65536, 2000, 600
"""Bytes of one read; reads that one call drops after it took all that it may; bytes in which a
stranger has to say that it is an autopilot."""
SAYS_S = 2.5
"""An older word of whether it is on the ground counts for nothing: it comes five times a second."""
BAUD = 921600
"""Of a serial device, where its connection names no other."""
ONBOARD_COMPUTER, SEVERITY = 191, {True: 4, False: 6}
SYNC_S, BEAT_S, ASK_S = 0.2, 1.0, 2.0
TEXT = 50
"""Most characters of a message of text."""
DAMAGED = -1
"""Number that pymavlink gives to bytes which are no message."""
WRONG = frozenset("damaged clock position velocity attitude stamp order".split())
"""Why a message cannot be used: no bytes of one, before the autopilot's clock is known, …"""
PASSED = "passed_over"
MOST_NS = 2**31 * 10**9
"""Stamps of ROS's messages end there."""


def dialect() -> Any:
    """pymavlink's, MAVLink 2. Raises `ConfigError`: it is not installed."""
    os.environ["MAVLINK20"] = "1"
    try:
        from pymavlink import mavutil
    except ImportError:
        msg = "autopilot_node needs pymavlink: pip install pymavlink pyserial"
        raise ConfigError(msg) from None
    return mavutil


class Link:
    """One autopilot at the other end; the first that is heard is the one that counts. By UDP only
    its address is heard and answered, until it has been silent for `PEER_S`.

    ``clock`` is this computer's time, ns, which poses are stamped by; ``now`` a steady one, s, of
    what is due, of ``heard``, when the last heartbeat came, and of ``answered``, when the last
    answer did. ``kind`` is ``ARDUPILOT``, ``PX4`` or None before the first. ``heard_of`` counts
    messages that told a ``pose``, ``half`` of one, the vehicle's ``state``, or nothing: those that
    were ``passed_over``, of others or without a meaning here; ``refused`` those that could not be
    used, by reason. Together these are all, but for the reads of a ``backlog`` that was dropped.
    Raises `ConfigError`: no pymavlink, or what is no connection; `QuadtreeLssError`: it cannot be
    opened at present.
    """

    def __init__(
        self,
        connection: str,
        clock: Callable[[], int],
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._connection = connection
        self._port = self._opened()
        self._clock, self._now = clock, now
        self.kind: int | None = None
        self.mode, self.armed = -1, False
        self._landed: bool | None = None
        self._landed_since = 0.0
        self._takes_off = False
        self.heard = self.answered = -np.inf
        self.remote = RemoteClock()
        self.heard_of: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self._system = 0
        self._due = dict.fromkeys(("sync", "beat", "ask", "settle", "connect"), 0.0)
        self._asked: deque[int] = deque(maxlen=RemoteClock.KEPT)
        self._attitudes: list[tuple[int, Array]] = []
        self._positions: list[tuple[int, Array, Array]] = []
        self._last_nav = self._last_state = -np.inf
        self._peer: Any = None
        self._newest, self._told = 0, 0

    @property
    def follows(self) -> bool:
        """Whether it flies to set-points by its mode, and is not taking off in that: ArduCopter
        would break off."""
        return self.kind is not None and self.mode == FOLLOWS[self.kind] and not self._takes_off

    @property
    def landed(self) -> bool | None:
        """Whether it says that it is on the ground; None if it has not said so lately."""
        return self._landed if self._now() - self._last_state <= SAYS_S else None

    @property
    def landed_for(self) -> float:
        """Since when it has said nothing else, s."""
        return self._now() - self._landed_since

    def _opened(self) -> Any:
        mavutil = dialect()
        device, _, rate = self._connection.partition(",")
        # Of the system that most autopilots are until it is heard: 255 is a ground station's.
        options = {"source_component": ONBOARD_COMPUTER, "source_system": 1, "autoreconnect": True}
        try:
            options |= {"baud": int(rate or BAUD), "retries": 1}  # it sleeps between more
            port = mavutil.mavlink_connection(device, **options)
            if hasattr(port, "baud"):  # a serial device
                port.port.exclusive = True
                port.write = self._write
            elif hasattr(port, "destination_addr") and hasattr(port, "udp_server"):
                port.port.connect(port.destination_addr)  # nobody else is heard
        except (OSError, ValueError, OverflowError, IndexError, ImportError) as error:
            msg = f"autopilot.connection = {self._connection!r} cannot be opened: {error}"
            later = isinstance(error, OSError)  # a device that comes: another start may help
            raise (QuadtreeLssError if later else ConfigError)(msg) from None
        return port

    def close(self) -> None:
        with suppress(AttributeError):  # there is none to a TCP peer that has gone
            self._port.close()

    def poll(self) -> list[Nav]:
        """Takes what has come, says what is due; new poses, oldest first."""
        navs: list[Nav] = []
        for message in self._messages():
            told = self._take(message)
            if isinstance(told, Nav):
                navs.append(told)
            elif told in WRONG:
                self.refused[told] += 1
                continue
            self.heard_of["pose" if isinstance(told, Nav) else told] += 1
        now = self._now()
        if navs:
            self._last_nav = now
        if self._is_due("beat", BEAT_S, now):
            self._say("heartbeat", 18, 8, 0, 0, 4)  # an onboard controller, not an autopilot
        if self.kind is not None:
            if self._is_due("sync", SYNC_S, now):
                self._asked.append(self._clock())
                self._say("timesync", 0, self._asked[-1])
            last = min(self._last_nav, self._last_state)
            if (now - last > 1.0 or not self._due["ask"]) and self._is_due("ask", ASK_S, now):
                for number in STREAMS[self.kind]:
                    self._command(SET_INTERVAL, number, 1e6 / POSE_HZ)
                for number in (EXTENDED, HEARTBEAT):
                    self._command(SET_INTERVAL, number, 1e6 / STATE_HZ)
        if self._peer is not None and now - self.heard > PEER_S:
            self._find_anew()
        return navs

    def fly_to(self, point: Array, sink: float = 0.0) -> None:
        """A set-point: a place in the map; ``sink``: how fast it goes down to the ground, m/s."""
        mask = SINKS if sink and self.kind == PX4 else PLACE_ALONE
        to, speed, nothing = (0, self._system, 1, LOCAL_NED, mask), (0.0, 0.0, sink), (0.0,) * 5
        self._say("set_position_target_local_ned", *to, *enu(point), *speed, *nothing)

    def show_target(self, place: Array, nav: Nav) -> None:
        """LANDING_TARGET, for the autopilot's own precision landing if it takes over."""
        vector, frame = enu(place), LOCAL_NED
        if self.kind == ARDUPILOT:
            vector, frame = body_frd(place - nav.position, nav.quaternion), BODY_FRD
        offset = self.remote.offset_ns or 0
        stamp_us = max(nav.stamp_ns - offset, 0) // 1000
        distance = float(np.linalg.norm(place - nav.position))
        seen, level = (0.0, 0.0, distance, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
        self._say("landing_target", stamp_us, 0, frame, *seen, *vector, level, 3, 1)

    def follow(self) -> None:
        """Asks for the mode in which set-points are followed."""
        if self.kind is not None:
            self._set_mode(FOLLOWS[self.kind])

    def settle(self, *, disarm: bool) -> None:
        """On the ground: asks for land mode, where that stops the motors, or disarms; of calls
        within a second once, so call it until it is done."""
        if not self._is_due("settle", BEAT_S, self._now()):
            return
        if disarm:
            self._command(ARM_DISARM, 0.0)
        elif self.kind in LAND:
            self._set_mode(LAND[self.kind])

    def tell(self, text: str, *, warn: bool) -> None:
        """A line for the pilot's ground station, in as many pieces as it takes."""
        line, self._told = text.encode("ascii", "replace"), self._told % 0xFFFF + 1
        pieces = range(0, len(line) + 1, TEXT) if len(line) > TEXT else (0,)
        for number, begin in enumerate(pieces):  # a piece that is not full is the last
            piece, whole = line[begin : begin + TEXT], len(pieces) == 1
            self._say("statustext", SEVERITY[warn], piece, 0 if whole else self._told, number)

    def _set_mode(self, mode: int) -> None:
        parts = (mode >> 16 & 0xFF, mode >> 24) if self.kind == PX4 else (mode,)
        self._command(DO_SET_MODE, CUSTOM_MODE, *parts)

    def _command(self, command: int, *values: float) -> None:
        padded = [*values, *[0.0] * (7 - len(values))]
        self._say("command_long", self._system, 1, command, 0, *padded)

    def _say(self, name: str, *values: Any) -> None:
        """Sends; a link that is gone is seen by the age of its heartbeats."""
        with suppress(OSError):
            if not self._is_away():
                getattr(self._port.mav, f"{name}_send")(*values)

    def _write(self, content: bytes) -> None:
        """To a serial device; pyserial would wait for one that takes nothing."""
        try:
            os.write(self._port.fd, content)
        except BlockingIOError:
            return
        except OSError:  # unplugged
            self._port.reset()

    def _is_away(self) -> bool:
        """True while a TCP peer has gone and it is too early to look for it again."""
        gone = getattr(self._port, "port", 0) is None
        return gone and not self._is_due("connect", ASK_S, self._now())

    def _is_due(self, what: str, period: float, now: float) -> bool:
        if 0.0 < self._due[what] - now <= period:  # more if a simulator began anew
            return False
        self._due[what] = now + period
        return True

    def _messages(self) -> Iterator[Any]:
        """What came, as far as there is time for it; drops the rest."""
        end, taken, parse = time.thread_time() + POLL_S, 0, self._port.mav.parse_char
        while (piece := self._read()) is not None:
            message = parse(piece)
            while message is not None:
                yield message
                taken += 1
                message = parse(b"") if taken < MOST_MESSAGES else None
            if taken >= MOST_MESSAGES or time.thread_time() > end:
                self._drop()
                return

    def _drop(self) -> None:
        self._port.mav.buf, self._port.mav.buf_index = bytearray(), 0
        for _ in range(MOST_PIECES):
            if self._read() is None:
                break
            self.refused["backlog"] += 1

    def _read(self) -> bytes | None:
        """Bytes that came; none of another than the autopilot; None if there are no more."""
        with suppress(OSError):
            if self._is_away():
                return None
            if not getattr(self._port, "udp_server", False):
                return self._port.recv(PIECE) or None
            piece, address = self._port.port.recvfrom(PIECE)
            if self._peer is None and self._speaks(piece):
                self._peer, self._port.clients = address, {address}
                self._port.port.connect(address)  # nobody else is queued
            if address == self._peer:
                return bytes(piece)
            self.heard_of[PASSED] += 1
            return b""
        return None

    def _speaks(self, piece: bytes) -> bool:
        """Whether an autopilot that counts speaks here."""
        says = dialect().mavlink.MAVLink(None)
        says.robust_parsing = True
        return any(
            message.get_msgId() == HEARTBEAT and self._counts(message)
            for message in says.parse_buffer(piece[:TELLS]) or ()
        )

    def _find_anew(self) -> None:
        """Listens to every address again, as the autopilot may have got another one."""
        with suppress(QuadtreeLssError):
            self._port.close()
            self._port, self._peer = self._opened(), None
            self._port.mav.srcSystem = self._system

    def _take(self, message: Any) -> Nav | str:
        """Takes one message: the pose that is known by it, or what it is instead."""
        number = message.get_msgId()
        if number == HEARTBEAT:
            return self._on_heartbeat(message)
        if number == DAMAGED:
            return "damaged"
        if message.get_srcSystem() != self._system or message.get_srcComponent() != 1:
            return PASSED
        if message.get_type() == "TIMESYNC" and message.tc1 > 0 and message.ts1 in self._asked:
            self.remote.add(message.ts1, message.tc1, self._clock())
            self.answered = self._now()
            return "state"
        if number == EXTENDED:
            if message.landed_state:  # 0: it does not know
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
            return self._paired()
        if number == ATTITUDE and self.kind == ARDUPILOT:
            q = np.array([message.q1, message.q2, message.q3, message.q4])
            self._attitudes = [*self._attitudes[-3:], (message.time_boot_ms, q)]
            return self._paired()
        return PASSED

    def _on_heartbeat(self, message: Any) -> str:
        if not self._counts(message):
            return PASSED
        if self.kind is None:
            self.kind, self._system = message.autopilot, message.get_srcSystem()
            self._port.mav.srcSystem = self._system
        self.heard = self._now()
        self.mode = message.custom_mode
        self.armed = bool(message.base_mode & ARMED)
        return "state"

    def _counts(self, message: Any) -> bool:
        """Whether a heartbeat is the autopilot's, or of one while there is none yet."""
        known = message.autopilot in FOLLOWS and message.type in COPTERS
        same = (message.autopilot, message.get_srcSystem()) == (self.kind, self._system)
        return known and message.get_srcComponent() == 1 and (same or self.kind is None)

    def _on_odometry(self, message: Any) -> Nav | str:
        place = np.array([message.x, message.y, message.z])
        velocity = np.array([message.vx, message.vy, message.vz])
        q, upper = np.array(message.q), np.array(message.pose_covariance)
        of_body = message.child_frame_id != LOCAL_NED  # PX4's own is not
        return self._nav(1000 * message.time_usec, place, q, velocity, upper, of_body=of_body)

    @np.errstate(invalid="ignore")  # judged by `_nav`
    def _paired(self) -> Nav | str:
        """Place and velocity of one moment, with the attitude between the two about it."""
        for at, place, velocity in reversed(self._positions):
            for (before, q0), (after, q1) in pairwise(self._attitudes):
                if before <= at <= after and after - before < 200:
                    self._positions = [one for one in self._positions if one[0] > at]
                    share = (at - before) / max(after - before, 1)
                    q = (1.0 - share) * q0 + share * (q1 if q0 @ q1 >= 0.0 else -q1)
                    return self._nav(at * 1_000_000, place, q, velocity, None, of_body=False)
        return "half"

    def _nav(
        self, at_ns: int, place: Array, q: Array, velocity: Array, upper: Array | None,
        *, of_body: bool,
    ) -> Nav | str:  # fmt: skip
        """By this computer's clock and in the map; or why it is no pose."""
        offset, length = self.remote.offset_ns, float(np.linalg.norm(q))
        if offset is None:
            return "clock"
        stamp = at_ns + offset
        if not (np.abs(place) <= MAX_HEIGHT).all():
            return "position"
        if not (np.abs(velocity) <= MAX_HEIGHT).all():
            return "velocity"
        if not abs(length - 1.0) < 0.05:
            return "attitude"
        if not 0 <= stamp < MOST_NS:
            return "stamp"
        if 0 <= self._newest - stamp < 1_000_000_000:  # the offset has just become better known
            return "order"
        self._newest = stamp
        turned = attitude(q / length)
        if of_body:
            velocity = rotation_from_quaternion(turned) @ (velocity * (1.0, -1.0, -1.0))
        else:
            velocity = enu(velocity)
        covariance = None if upper is None else covariance_enu(upper, turned)
        return Nav(stamp, enu(place), turned, velocity, covariance, at_ns)
