# SPDX-License-Identifier: Apache-2.0
"""Base class of the nodes, and the function that runs a node from start to exit."""

from __future__ import annotations

import contextlib
import math
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from itertools import pairwise

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

import quadtree_lss
from quadtree_lss import build
from quadtree_lss.onboard.config.loading import read_values
from quadtree_lss.onboard.config.settings import Config, ConfigError, parameters, values_from_config
from quadtree_lss.onboard.errors import QuadtreeLssError
from quadtree_lss.onboard.nodes.diagnostics import WARN, Problems, Status
from quadtree_lss.onboard.nodes.entry import set_waiting_for, stop_on_signal
from quadtree_lss.onboard.nodes.parameters import NodeParameters
from quadtree_lss.onboard.nodes.qos import steady_timer

ARGUMENT_ERRORS = (
    rclpy_implementation.RCLInvalidROSArgsError,
    rclpy_implementation.UnknownROSArgsError,
    rclpy_implementation.RCLError,
)

CONFIGURATION_ERRORS = (ConfigError, NameValidationException, ParameterException)

WRONG_CONFIGURATION = 78
"""Exit code for which a restart cannot help (EX_CONFIG of sysexits.h), like 2."""

STOP_PERIOD_S = 0.2
"""Period with which an idle node checks for a signal."""

TRANSPORTS = "UDPv4?sockets_size=16MB"
"""Default transports of Fast DDS: no shared memory, and large buffers for scans.

Segments that a killed process leaves in shared memory can prevent its successor from receiving
(studies/RESULTS.md). The kernel limits the buffers to net.core.rmem_max.
"""

STATUS_S = 1.0
"""Period of ``/diagnostics`` that ROS's aggregators expect."""
MAX_AGE_S = 600.0
"""Difference of stamps and clock above which they are unrelated, as for a bag without ``/clock``.
"""


class BaseNode(Node):
    """Node with the parameters of the table. It publishes its status every `STATUS_S`: the content
    of `_collect` and the counted problems; new problems are a warning."""

    def __init__(self, name: str) -> None:
        super().__init__(name, automatically_declare_parameters_from_overrides=True)
        self._settings = NodeParameters(self, self._reconfigure, name)
        self._problems = Problems(self.get_logger())
        self._build, self._problems_reported = build.name(), 0
        self._statuses = self.create_publisher(
            DiagnosticArray, "/diagnostics", QoSProfile(depth=10)
        )
        steady_timer(self, STATUS_S, self._send_status)

    @property
    def _config(self) -> Config:
        """Current configuration."""
        return self._settings.config

    def _reconfigure(self, config: Config) -> None:
        """Apply changed live parameters."""

    def _collect(self, status: Status) -> None:
        """Fill in the node's status."""
        raise NotImplementedError

    def finish(self) -> None:
        """Complete pending work before a regular exit."""

    def _age(self, stamp_ns: int) -> float:
        """Return the time since a stamp by the node's clock, s; NaN if the two are unrelated."""
        age = 1e-9 * (self.get_clock().now().nanoseconds - stamp_ns)
        return age if abs(age) < MAX_AGE_S else math.nan

    def _announce(self) -> None:
        """Log version, build, configuration, domain and vehicle, and unused QoS overrides."""
        self._settings.warn_unused(self)
        parts = (
            f"quadtree_lss {quadtree_lss.__version__} ({self._build})",
            configuration_text(self._config),
            ground_text(self._config),
        )
        set_waiting_for("", self.get_logger().warning)
        self.get_logger().info("; ".join(parts))

    def _send_status(self) -> None:
        state, problems = Status(), self._problems
        state.add({"build": self._build})
        self._collect(state)
        if self.get_clock().ros_time_is_active and not self.get_clock().now().nanoseconds:
            text = "use_sim_time is set, but no time came on '/clock': ages of stamps are unknown"
            problems.report("no_clock", text)
        total = problems.counts.total()
        if total > self._problems_reported:
            new = total - self._problems_reported
            state.note(WARN, f"{new} new problems, the last: {problems.latest}")
        self._problems_reported = total
        state.add({f"problems.{key}": n for key, n in problems.counts.items()})
        status = DiagnosticStatus(level=state.level, message=state.text)
        status.name = self.get_fully_qualified_name().lstrip("/")
        status.hardware_id = self.get_namespace()
        status.values = [KeyValue(key=key, value=str(v)) for key, v in state.values.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._statuses.publish(message)


def run(
    make_node: Callable[[], BaseNode], description: str, args: Sequence[str] | None = None
) -> int:
    """Run one node until SIGINT, SIGTERM, SIGHUP or shutdown.

    ``description``: first line of ``--help``; ``args``: command line, ``sys.argv`` by default.
    Returns the exit code: 0 after a signal, 1 if the node could not start, 2 for wrong arguments,
    `WRONG_CONFIGURATION` for wrong parameters or names.
    """
    argv = list(sys.argv if args is None else args)
    try:
        own = remove_ros_args(argv)[1:]
    except ARGUMENT_ERRORS as error:
        return _wrong_arguments(error)
    if "-h" in own or "--help" in own:
        with contextlib.suppress(BrokenPipeError):  # as with `| head`
            usage = "[--ros-args --params-file FILE -p NAME:=VALUE -r FROM:=TO ...]"
            print(f"{description}\n\nusage: {os.path.basename(argv[0])} {usage}", flush=True)
        return 0
    if own:
        print(f"unknown argument {own[0]!r}; ROS arguments follow --ros-args", file=sys.stderr)
        return 2
    if "ROS_LOG_DIR" not in os.environ and "HOME" not in os.environ:
        os.environ["ROS_LOG_DIR"] = tempfile.gettempdir()
    os.environ.setdefault("FASTDDS_BUILTIN_TRANSPORTS", TRANSPORTS)
    return _spin(make_node, argv)


def _spin(make_node: Callable[[], BaseNode], argv: list[str]) -> int:
    executor: SingleThreadedExecutor | None = None
    node: BaseNode | None = None
    stop = stop_on_signal()
    if stop.requested:
        return 0
    set_waiting_for("ROS and its middleware")
    try:
        rclpy.init(args=argv, signal_handler_options=SignalHandlerOptions.NO)
    except ARGUMENT_ERRORS as error:
        return _wrong_arguments(error)
    set_waiting_for("its parameters and topics")
    try:
        node = make_node()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        with contextlib.suppress(ExternalShutdownException), stop.interrupting():
            while not stop.requested:
                executor.spin_once(timeout_sec=STOP_PERIOD_S)
        node.finish()  # not after an exception, when the map may be inconsistent
    except KeyboardInterrupt:  # the same holds for an interrupted callback
        print("second signal: interrupted", file=sys.stderr)
    except (*CONFIGURATION_ERRORS, QuadtreeLssError, rclpy_implementation.RCLError) as error:
        print(f"error: {_rcl_message(error)}", file=sys.stderr)
        return WRONG_CONFIGURATION if isinstance(error, CONFIGURATION_ERRORS) else 1
    finally:
        if executor is not None:
            executor.shutdown()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _rcl_message(error: Exception) -> str:
    """Return a message in one line, without the source location that rcl adds."""
    return " ".join(str(error).split(", at /")[0].split())


def _wrong_arguments(error: Exception) -> int:
    """Print rcl's error for arguments or ROS_… variables on one line; return the exit code."""
    unknown = isinstance(error, rclpy_implementation.UnknownROSArgsError)
    print(f"error: {'unknown ROS arguments ' * unknown}{_rcl_message(error)}", file=sys.stderr)
    return 2


def configuration_text(config: Config) -> str:
    """Describe the values that differ from the defaults, with the files that set them."""
    origin: dict[str, str] = {}
    for option, value in pairwise(sys.argv):
        if option == "--params-file":
            with contextlib.suppress(ConfigError):  # ROS accepts more forms than `read_values`
                origin |= dict.fromkeys(read_values(value), value)
        elif option in ("-p", "--param"):
            origin.pop(value.partition(":=")[0], None)
    values = values_from_config(config)
    changed: dict[str, list[str]] = {}
    for row in parameters():
        if values[row.name] != row.default:
            source = origin.get(row.name, "command line")
            changed.setdefault(source, []).append(f"{row.name}={values[row.name]}")
    parts = [f"{', '.join(items)} (from {source})" for source, items in changed.items()]
    return f"configuration other than the defaults: {', '.join(parts) or 'none'}"


def ground_text(config: Config) -> str:
    """Describe domain, cells and vehicle."""
    d, lss = config.domain, config.lss
    sizes = [d.size / 2**level for level in (d.min_level, d.max_level)]
    return (
        f"domain x {d.xmin:g} ... {d.xmin + d.size:g}, y {d.ymin:g} ... {d.ymin + d.size:g} m"
        f" in frame '{config.frames.map}', cells {sizes[0]:g} ... {sizes[1]:g} m;"
        f" vehicle of {lss.vehicle.diameter:g} m diameter, margin {lss.margin:g} m"
    )
