# SPDX-License-Identifier: Apache-2.0
"""Starting and ending the installed programs as processes of their own.

launch_testing, domain_coordinator and ros2 run do this where ROS is installed; none is in a wheel.
"""

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
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

from quadtree_lss.onboard.errors import QuadtreeLssError

PACKAGE = "quadtree_lss"

LOCAL_PROFILE = """\
<?xml version="1.0" encoding="UTF-8"?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <transport_descriptors>
    <transport_descriptor>
      <transport_id>udp</transport_id>
      <type>UDPv4</type>
      <sendBufferSize>16000000</sendBufferSize>
      <receiveBufferSize>16000000</receiveBufferSize>
      <maxInitialPeersRange>32</maxInitialPeersRange>
    </transport_descriptor>
  </transport_descriptors>
  <participant profile_name="local" is_default_profile="true">
    <rtps>
      <userTransports>
        <transport_id>udp</transport_id>
      </userTransports>
      <useBuiltinTransports>false</useBuiltinTransports>
      <builtin>
        <discovery_config>
          <leaseAnnouncement>
            <nanosec>200000000</nanosec>
          </leaseAnnouncement>
        </discovery_config>
        <metatrafficUnicastLocatorList>
          <locator/>
        </metatrafficUnicastLocatorList>
        <initialPeersList>
          <locator><udpv4><address>127.0.0.1</address></udpv4></locator>
        </initialPeersList>
      </builtin>
    </rtps>
  </participant>
</profiles>
"""
"""For Fast DDS: what ROS's range LOCALHOST does, which brings in shared memory, without it."""


# Ports of a domain (RTPS specification, 9.6.1.1): those of participant k begin at 10 + 2 k.
FIRST_PORT, PORTS_PER_DOMAIN = 7400, 250
PARTICIPANT_PORTS = range(10, 10 + 2 * 32)
RESERVATION_PORT = PORTS_PER_DOMAIN - 1
DOMAINS = range(1, 98)
LAST_DOMAIN = 231
LOOK_S = 2.0
"""So long after we joined everybody who is there is known."""


class ProcessError(QuadtreeLssError):
    """A program is not installed or ended when it should not."""


def program(name: str) -> Path:
    """Path of an installed executable as ``ros2 run quadtree_lss <name>`` finds it. Raises
    `ProcessError`: it is not installed."""
    prefixes = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    for prefix in (sys.prefix, *prefixes):
        path = Path(prefix) / "lib" / PACKAGE / name
        if path.is_file():
            return path
    msg = f"{name} is not installed under {sys.prefix}: run `make setup` (or colcon build) first"
    raise ProcessError(msg)


@dataclass(frozen=True)
class LocalDomain:
    """A ROS domain that stays on this computer: its ``ROS_DOMAIN_ID``, and the environment of the
    processes that take part in it."""

    number: int
    env: dict[str, str]


def given_domain() -> int | None:
    """What ``ROS_DOMAIN_ID`` says, None without it. Raises `ProcessError`: it is no domain."""
    text = os.environ.get("ROS_DOMAIN_ID", "")
    if not text:
        return None
    if not text.isdecimal() or int(text[:4]) > LAST_DOMAIN:
        msg = f"ROS_DOMAIN_ID is {text!r}: it must be a whole number from 0 to {LAST_DOMAIN}"
        raise ProcessError(msg)
    return int(text)


def strangers(node: Any, ours: Mapping[str, int]) -> list[str]:
    """Topics that more publish than we do, each with the nodes that do. ``ours``: how many of us
    publish each."""
    found = []
    for topic, count in ours.items():
        there = node.get_publishers_info_by_topic(topic)
        if len(there) > count:
            names = sorted({f"{i.node_namespace.rstrip('/')}/{i.node_name}" for i in there})
            found.append(f"{topic} ({', '.join(names)})")
    return found


def refuse_company(node: Any, ours: Mapping[str, int]) -> None:
    """Look before we speak: raises `ProcessError` where others publish what we shall; arguments as
    of `strangers`."""
    time.sleep(LOOK_S)
    if found := strangers(node, ours):
        msg = f"others in this ROS domain publish {'; '.join(found)}: set another ROS_DOMAIN_ID"
        raise ProcessError(msg)


@contextmanager
def local_domain(log_dir: Path, given: int | None = None) -> Iterator[LocalDomain]:
    """A ROS domain for this process and those started with its environment: the ``given`` one,
    whoever else may be there, or one of one's own. However many ask at once on this computer, each
    has another one until it leaves the context, in which SIGTERM interrupts as Ctrl-C does, so that
    processes end. Raises `ProcessError`: all domains are taken, or another asked for the given
    one."""
    number, reservation = _reserve_domain() if given is None else (given, None)
    reservation = reservation or _bound(number, RESERVATION_PORT)
    if reservation is None:
        msg = f"another flight or demo has ROS domain {number}: set another ROS_DOMAIN_ID"
        raise ProcessError(msg)
    env = _local_environment(number, log_dir)
    with reservation, mock.patch.dict(os.environ, env), _interrupted_by_sigterm():
        yield LocalDomain(number, env)


@contextmanager
def _interrupted_by_sigterm() -> Iterator[None]:
    before: Any = signal.SIG_DFL
    with suppress(ValueError):  # not the main thread, which alone hears it
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        with suppress(ValueError):
            signal.signal(signal.SIGTERM, before)


def _reserve_domain() -> tuple[int, socket.socket]:
    """A domain without participants, and what keeps others from it until it is closed.

    Seeing that nobody is there would not do: a process takes a second to join after it was told
    the number. So each that asks first holds the domain's last port, which no participant reaches.
    """
    for domain in random.SystemRandom().sample(list(DOMAINS), len(DOMAINS)):
        reservation = _bound(domain, RESERVATION_PORT)
        if reservation is None:
            continue
        probes = [_bound(domain, port) for port in PARTICIPANT_PORTS]
        for probe in filter(None, probes):
            probe.close()
        if all(probes):
            return domain, reservation
        reservation.close()
    raise ProcessError(f"no free ROS domain between {min(DOMAINS)} and {max(DOMAINS)}")


def _bound(domain: int, port: int) -> socket.socket | None:
    """Socket at a port of the domain, None if it is in use."""
    result = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        result.bind(("", FIRST_PORT + PORTS_PER_DOMAIN * domain + port))
    except OSError:
        result.close()
        return None
    return result


def _local_environment(domain: int, log_dir: Path) -> dict[str, str]:
    """This process's environment with a ROS domain that stays on this computer."""
    env = {
        **os.environ,
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(log_dir),
        "PYTHONUNBUFFERED": "1",
    }
    if "fastrtps" in env.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp"):
        log_dir.mkdir(parents=True, exist_ok=True)
        profile = log_dir / "fastdds.xml"
        profile.write_text(LOCAL_PROFILE, encoding="utf-8")
        env["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SYSTEM_DEFAULT"
        env["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(profile)
    return env


class NodeProcess:
    """One of our nodes as a process, with what follows ``--ros-args`` and a file that takes its
    output; ends it when the context is left."""

    def __init__(self, name: str, ros_args: Sequence[str], env: dict[str, str], log: Path) -> None:
        self.name = name
        self.log = log
        command = [str(program(name)), "--ros-args", *ros_args]
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("wb") as output:
            self.process = subprocess.Popen(
                command, env=env, stdout=output, stderr=subprocess.STDOUT
            )

    def output(self) -> str:
        """Everything it has written so far."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    def check(self) -> None:
        """Raises ProcessError if it has ended."""
        code = self.process.poll()
        if code is not None:
            said = " ".join(self.output().split())[-500:]
            msg = f"{self.name} ended with exit code {code}: {said}"
            raise ProcessError(msg)

    def stop(self, signal_number: int = signal.SIGINT, timeout: float = 15.0) -> int:
        """Asks it to end, kills it if it does not, or if we are interrupted; its exit code."""
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
