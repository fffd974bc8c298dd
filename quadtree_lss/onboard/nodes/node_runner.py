# SPDX-License-Identifier: Apache-2.0
"""Base class of the nodes, and the function that runs a node from start to exit."""

from __future__ import annotations

import contextlib
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
from quadtree_lss.onboard.nodes.executor import steady_timer
from quadtree_lss.onboard.nodes.parameters import NodeParameters

ARGUMENT_ERRORS = (
    rclpy_implementation.RCLInvalidROSArgsError,
    rclpy_implementation.UnknownROSArgsError,
    rclpy_implementation.RCLError,
)

WRONG_CONFIGURATION = 78
"""Exit code for which a restart cannot help (EX_CONFIG of sysexits.h), like 2."""

STOP_PERIOD_S = 0.2
"""Period with which an idle node checks for a signal."""

TRANSPORTS = "UDPv4?sockets_size=16MB"
"""Default transports of Fast DDS: no shared memory, and large buffers for scans.

After a killed process, segments left in shared memory can prevent its successor on the same port
from receiving for ten seconds or forever (studies/RESULTS.md). The kernel limits the buffers to
net.core.rmem_max.
"""

STATUS_S = 1.0
"""Period of ``/diagnostics`` that ROS's aggregators expect."""
MEANINGFUL_LATENCY_S = 600.0
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

    def _latency_ms(self, stamp_ns: int) -> float | None:
        """Return the time since a stamp by the node's clock; None if the two are unrelated."""
        latency = 1e-9 * (self.get_clock().now().nanoseconds - stamp_ns)
        return 1e3 * latency if abs(latency) < MEANINGFUL_LATENCY_S else None

    def _announce(self) -> None:
        """Log version, build, configuration, domain and vehicle, and unused QoS overrides."""
        self._settings.warn_unused(self)
        parts = (
            f"quadtree_lss {quadtree_lss.__version__} ({self._build})",
            configuration_text(self._config, sys.argv),
            *ground_text(self._config),
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

    Args:
        make_node: Creates the node; called after ROS is initialised.
        description: First line of ``--help``.
        args: Command line with the program's name; ``sys.argv`` by default.

    Returns:
        Exit code: 0 after a signal, 1 if the node could not start, 2 for wrong arguments,
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
        node = _create_node(make_node)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        with contextlib.suppress(ExternalShutdownException), stop.interrupting():
            while not stop.requested:
                executor.spin_once(timeout_sec=STOP_PERIOD_S)
        node.finish()  # not after an exception, when the map may be inconsistent
    except KeyboardInterrupt:  # the same holds for an interrupted callback
        print("second signal: interrupted", file=sys.stderr)
    except QuadtreeLssError as error:
        print(f"error: {error}", file=sys.stderr)
        return WRONG_CONFIGURATION if isinstance(error, ConfigError) else 1
    finally:
        if executor is not None:
            executor.shutdown()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _create_node(make_node: Callable[[], BaseNode]) -> BaseNode:
    """Create the node. Raises `ConfigError` for wrong parameters, names or overrides, and
    `QuadtreeLssError` if the middleware fails."""
    try:
        return make_node()
    except (NameValidationException, ParameterException) as error:
        raise ConfigError(_rcl_message(error)) from None
    except rclpy_implementation.RCLError as error:
        raise QuadtreeLssError(_rcl_message(error)) from None


def _rcl_message(error: Exception) -> str:
    """Return the message of rcl without its source location."""
    return " ".join(str(error).split(", at /")[0].split())


def _wrong_arguments(error: Exception) -> int:
    """Print rcl's error for arguments or ROS_… variables on one line; return the exit code."""
    if isinstance(error, rclpy_implementation.UnknownROSArgsError):
        text = f"unknown ROS arguments {error}"
    else:
        text = _rcl_message(error)
    print(f"error: {text}", file=sys.stderr)
    return 2


def configuration_text(config: Config, arguments: Sequence[str]) -> str:
    """Describe the values that differ from the defaults, with the files that set them;
    ``arguments``: command line."""
    origin: dict[str, str] = {}
    for option, value in pairwise(arguments):
        if option == "--params-file":
            with contextlib.suppress(ConfigError):  # ROS accepts more forms than `read_values`
                origin |= dict.fromkeys(read_values(value), value)
        elif option in ("-p", "--param"):
            origin.pop(value.partition(":=")[0], None)
    values = values_from_config(config)
    changed = [row.name for row in parameters() if values[row.name] != row.default]
    files = [path for option, path in pairwise(arguments) if option == "--params-file"]
    if not changed:
        return f"configuration: the defaults{' (as in ' + ', '.join(files) + ')' if files else ''}"
    parts, command_line = [], "command line"
    for source in dict.fromkeys([*files, command_line]):
        set_by = [f"{n}={values[n]}" for n in changed if origin.get(n, command_line) == source]
        if set_by:
            parts.append(f"{', '.join(set_by)} (from {source})")
        elif source != command_line:
            parts.append(f"{source} (only defaults)")
    return f"configuration other than the defaults: {', '.join(parts)}"


def ground_text(config: Config) -> list[str]:
    """Describe domain, cells and vehicle."""
    d, lss = config.domain, config.lss
    sizes = [d.size / 2**level for level in (d.min_level, d.max_level)]
    return [
        f"domain x {d.xmin:g} ... {d.xmin + d.size:g}, y {d.ymin:g} ... {d.ymin + d.size:g} m"
        f" in frame '{config.frames.map}', cells {sizes[0]:g} ... {sizes[1]:g} m",
        f"vehicle of {lss.vehicle.diameter:g} m diameter, margin {lss.margin:g} m",
    ]
