# SPDX-License-Identifier: Apache-2.0
"""Start and end the installed programs as processes in a ROS domain of their own, as do
launch_testing and domain_coordinator, which are not available as wheels."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from unittest import mock

from quadtree_lss.onboard.errors import QuadtreeLssError

PACKAGE = "quadtree_lss"
#: Fast DDS profile: discovery as in the ROS range LOCALHOST, without shared memory.
LOCAL_PROFILE = Path(__file__).with_name("fastdds.xml")
#: Ports of a domain (RTPS specification, 9.6.1.1). Participants use the first ports, here up to 32
#: participants; the last port serves here to reserve a domain.
FIRST_PORT, PORTS_PER_DOMAIN = 7400, 250
PARTICIPANT_PORTS, RESERVATION_PORT = range(10, 74), PORTS_PER_DOMAIN - 1
DOMAINS, LAST_DOMAIN = range(1, 98), 231
#: Time to discover all other participants, s.
DISCOVERY_S = 2.0


class ProcessError(QuadtreeLssError):
    """A program is not installed, or ended unexpectedly."""


def program(name: str) -> Path:
    """Find an installed executable as ``ros2 run quadtree_lss <name>`` does. Raises `ProcessError`:
    it is not installed."""
    prefixes = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    for prefix in (sys.prefix, *prefixes):
        path = Path(prefix) / "lib" / PACKAGE / name
        if path.is_file():
            return path
    msg = f"{name} is not installed under {sys.prefix}: run `make setup` (or colcon build) first"
    raise ProcessError(msg)


def environment_domain() -> int | None:
    """Return ``ROS_DOMAIN_ID``, or None. Raises `ProcessError`: it is not a domain."""
    text = os.environ.get("ROS_DOMAIN_ID", "")
    if not text:
        return None
    if not text.isdecimal() or int(text[:4]) > LAST_DOMAIN:
        allowed = f"a whole number from 0 to {LAST_DOMAIN}"
        raise ProcessError(f"ROS_DOMAIN_ID is {text!r}: it must be {allowed}")
    return int(text)


def check_publishers(node: Any, ours: Mapping[str, int]) -> None:
    """Raise `ProcessError` if a topic has more publishers than its number in ``ours``."""
    time.sleep(DISCOVERY_S)
    if others := [topic for topic, count in ours.items() if node.count_publishers(topic) > count]:
        msg = f"others in this ROS domain publish {', '.join(others)}: set another ROS_DOMAIN_ID"
        raise ProcessError(msg)


@contextmanager
def local_domain(log_dir: Path, given: int | None = None) -> Iterator[int]:
    """Reserve a ROS domain for this process and its children: the ``given`` one or one without
    participants. The environment limits it to this computer, and SIGTERM acts like Ctrl-C, so that
    the children end.
    Raises `ProcessError`: other programs have reserved the domain, or all domains."""
    if given is None:
        found = (
            (n, _reserve_empty(n)) for n in random.SystemRandom().sample(DOMAINS, len(DOMAINS))
        )
        number, reservation = next((one for one in found if one[1]), (-1, None))
    else:
        number, reservation = given, _bind(given, RESERVATION_PORT)
    if reservation is None:
        which = f"between {min(DOMAINS)} and {max(DOMAINS)}" if given is None else f"{given}"
        raise ProcessError(f"no free ROS domain {which}: set another ROS_DOMAIN_ID")
    env = {
        "ROS_DOMAIN_ID": str(number),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(log_dir),
        "PYTHONUNBUFFERED": "1",
    }
    if "fastrtps" in os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp"):
        env["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SYSTEM_DEFAULT"
        env["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(LOCAL_PROFILE)
    with reservation, mock.patch.dict(os.environ, env), _interrupted_by_sigterm():
        yield number


@contextmanager
def _interrupted_by_sigterm() -> Iterator[None]:
    before: Any = signal.SIG_DFL
    with suppress(ValueError):  # only the main thread receives signals
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        with suppress(ValueError):
            signal.signal(signal.SIGTERM, before)


def _reserve_empty(domain: int) -> socket.socket | None:
    """Reserve a domain without participants, such as nodes of a killed program; return None if it
    is reserved or has participants. The reservation precedes the check, because a process joins its
    domain a second after its start."""
    reservation = _bind(domain, RESERVATION_PORT)
    if reservation is None:
        return None
    for port in PARTICIPANT_PORTS:
        free = _bind(domain, port)
        if free is None:
            reservation.close()
            return None
        free.close()
    return reservation


def _bind(domain: int, port: int) -> socket.socket | None:
    """Bind a port of a domain; return None if another program has bound it."""
    result = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        result.bind(("", FIRST_PORT + PORTS_PER_DOMAIN * domain + port))
    except OSError:
        result.close()
        return None
    return result


class NodeProcess:
    """A node as a process with ROS arguments and an output file; it ends with the context."""

    def __init__(
        self, name: str, ros_args: Sequence[str], log: Path, env: Mapping[str, str] | None = None
    ) -> None:
        self.name = name
        self.log = log
        command = [str(program(name)), "--ros-args", *ros_args]
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("wb") as output:
            self.process = subprocess.Popen(
                command, env=env, stdout=output, stderr=subprocess.STDOUT
            )

    def output(self) -> str:
        return self.log.read_text(encoding="utf-8", errors="replace")

    def check(self) -> None:
        """Raise `ProcessError` if the process has ended."""
        code = self.process.poll()
        if code is not None:
            said = " ".join(self.output().split())[-500:]
            raise ProcessError(f"{self.name} ended with exit code {code}: {said}")

    def stop(self, signal_number: int = signal.SIGINT, timeout: float = 15.0) -> int:
        """End the process by a signal, or by SIGKILL after the timeout; return its exit code."""
        try:
            self.process.send_signal(signal_number)
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(timeout)
        finally:
            self.process.kill()
            code = self.process.wait()
        return code

    def __enter__(self) -> NodeProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
