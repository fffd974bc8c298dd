# SPDX-License-Identifier: Apache-2.0
"""Nodes as real processes, each test in a ROS domain of its own on this computer alone."""

import importlib.util
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

if importlib.util.find_spec("rclpy") is None:
    collect_ignore_glob = ["test_*.py"]
else:
    from diagnostic_msgs.msg import DiagnosticStatus
    from rcl_interfaces.msg import SetParametersResult
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter
    from std_srvs.srv import Trigger

    from quadtree_lss.lab.live.listener import TOPICS, Listener
    from quadtree_lss.lab.live.processes import NodeProcess, local_domain

    OK, WARN, ERROR = (DiagnosticStatus.OK,), (DiagnosticStatus.WARN,), (DiagnosticStatus.ERROR,)

PARAMETERS = """\
/**:
  ros__parameters:
    domain: {xmin: -16.0, ymin: -16.0, size: 32.0, min_level: 3, max_level: 6}
    lidar: {range_noise: 0.03}
    lss: {grid_spacing: 0.5, sites: 3}
    qos: {scan_reliability: reliable}
    publish.rate: 11.0
"""


def status_values(listener: Listener, name: str) -> dict[str, str]:
    """Values by key of the last diagnostic status of a node."""
    status = listener.diagnostics.get(name)
    return {} if status is None else {item.key: item.value for item in status.values}


def has(listener: Listener, key: str, number: int, node: str = "mapping_node") -> bool:
    """True if a diagnostic value is this number."""
    return status_values(listener, node).get(key) == str(number)


def at_least(listener: Listener, key: str, number: int, node: str = "mapping_node") -> bool:
    """True if a diagnostic value is this number or more."""
    return int(status_values(listener, node).get(key, 0)) >= number


def told(listener: Listener, node: str, *words: str, levels: Sequence[bytes] = ()) -> bool:
    """True if the last status of a node has all these words, and a level of those given."""
    status = listener.diagnostics.get(node)
    found = status is not None and all(word in status.message for word in words)
    return found and (not levels or status.level in levels)


@contextmanager
def process(command: list[str], **how: Any) -> Iterator[subprocess.Popen[str]]:
    """A program that ends with the context, whatever happens."""
    with subprocess.Popen(command, text=True, **how) as running:
        try:
            yield running
        finally:
            running.kill()


class Ros:
    """A domain with the processes and listeners of one test."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        domain = stack.enter_context(local_domain(folder / "log"))
        self.domain, self.env = domain.number, domain.env
        self.folder = folder
        self.params = folder / "params.yaml"
        self.params.write_text(PARAMETERS)
        self._stack = stack
        self._count = 0

    def start(self, name: str, *args: str) -> NodeProcess:
        """A node with the test's parameters; its output goes to a file of its own."""
        self._count += 1
        log = self.folder / f"{self._count}_{name}.txt"
        ros_args = ["--params-file", str(self.params), *args]
        return self._stack.enter_context(NodeProcess(name, ros_args, self.env, log))

    def listen(self, topics: Mapping[str, Any] = TOPICS) -> Listener:
        """Collects the nodes' topics, as a context manager."""
        return Listener(self.domain, topics)

    def call(self, listener: Listener, service: str) -> Trigger.Response:
        """Answer of a Trigger service."""
        return self._ask(listener, Trigger, service, Trigger.Request())

    def set(self, listener: Listener, node: str, name: str, value: object) -> SetParametersResult:
        """What a node says to a new value of a parameter, as ``ros2 param set`` asks it."""
        request = SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg()]
        )
        service = f"/{node}/set_parameters"
        return self._ask(listener, SetParameters, service, request).results[0]

    def _ask(self, listener: Listener, kind: Any, service: str, request: Any) -> Any:
        client = listener.node.create_client(kind, service)
        assert listener.wait_for(client.service_is_ready), f"no service {service}"
        future = client.call_async(request)
        assert listener.wait_for(future.done), f"{service} does not answer"
        listener.node.destroy_client(client)
        return future.result()


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Ros]:
    """See `Ros`."""
    with ExitStack() as stack:
        yield Ros(tmp_path, stack)
