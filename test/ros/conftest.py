# SPDX-License-Identifier: Apache-2.0
"""Nodes as processes; each test has its own ROS domain, on this computer only."""

from __future__ import annotations

import importlib.util
import os
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

if importlib.util.find_spec("rclpy") is None:
    collect_ignore_glob = ["test_*.py"]
else:
    import rclpy
    from rcl_interfaces.msg import SetParametersResult
    from rcl_interfaces.srv import SetParameters
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node
    from rclpy.parameter import Parameter
    from ros_scene import Ears, Sensors, mapped
    from std_srvs.srv import Trigger

    from quadtree_lss.desk.replay.configuration import load_config
    from quadtree_lss.lab.live.listener import TOPICS, Listener
    from quadtree_lss.lab.live.processes import NodeProcess, local_domain
    from quadtree_lss.onboard.core.tree.cell_map import CellMap

PARAMETERS = """\
/**:
  ros__parameters:
    domain: {xmin: -16.0, ymin: -16.0, size: 32.0, min_level: 3, max_level: 6}
    lidar: {range_noise: 0.03}
    lss: {grid_spacing: 0.5, sites: 3}
    qos_overrides./lidar/points.subscription.reliability: reliable
    diagnostics.warn_age: 5.0  # leave out no scan on a busy computer
    publish.rate: 11.0
"""


class Ros:
    """ROS domain with the processes and listeners of one test."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.domain = stack.enter_context(local_domain(folder / "log"))
        self.env = dict(os.environ)
        self.folder = folder
        self.params = folder / "params.yaml"
        self.params.write_text(PARAMETERS)
        self._stack = stack
        self._nodes: list[NodeProcess] = []

    def start(self, name: str, *args: str, first: str = "") -> NodeProcess:
        """A node with the test's parameters; its output goes to a file of its own. It, and what is
        started after it, runs a program ``first``."""
        log = self.folder / f"{len(self._nodes)}_{name}.txt"
        if first:
            (self.folder / "sitecustomize.py").write_text(first)
            before = filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
            self.env["PYTHONPATH"] = os.pathsep.join([str(self.folder), *before])
        ros_args = ["--params-file", str(self.params), *args]
        self._nodes.append(NodeProcess(name, ros_args, log, self.env))
        return self._stack.enter_context(self._nodes[-1])

    def output(self) -> str:
        """Return the output of all nodes."""
        return "\n".join(node.output() for node in self._nodes)

    def run(self, *command: object) -> subprocess.CompletedProcess[str]:
        """Run another program in this domain and return its result."""
        words = [str(word) for word in command]
        return subprocess.run(words, env=self.env, capture_output=True, text=True, check=False)

    def listen(self, topics: Mapping[str, Any] | None = None) -> Ears:
        """Record the nodes' topics, as a context manager."""
        return Ears(self, TOPICS if topics is None else topics)

    @contextmanager
    def sensors(self, topics: Mapping[str, Any] | None = None) -> Iterator[tuple[Ears, Sensors]]:
        """Return a listener, and sensors that are matched with a mapping node."""
        with self.listen(topics) as listener:
            yield listener, Sensors(listener).matched()

    def call(self, listener: Listener, service: str) -> Trigger.Response:
        """Call a Trigger service and return its response."""
        return self._ask(listener, Trigger, service, Trigger.Request())

    def set(self, listener: Listener, node: str, name: str, value: object) -> SetParametersResult:
        """Set a parameter of a node as ``ros2 param set`` does, and return the result."""
        given = [Parameter(name, value=value).to_parameter_msg()]
        request, service = SetParameters.Request(parameters=given), f"/{node}/set_parameters"
        return self._ask(listener, SetParameters, service, request).results[0]

    def _ask(self, listener: Listener, kind: Any, service: str, request: Any) -> Any:
        client = listener.node.create_client(kind, service)
        assert listener.wait_for(client.service_is_ready), f"no service {service}"
        future = client.call_async(request)
        assert listener.wait_for(future.done), f"{service} does not answer"
        return future.result()


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Ros]:
    """See `Ros`."""
    with ExitStack() as stack:
        yield Ros(tmp_path, stack)


@pytest.fixture(scope="session")
def cells() -> CellMap:
    """Map with sites everywhere."""
    domain = {"xmin": -16.0, "ymin": -16.0, "size": 32.0, "min_level": 3, "max_level": 6}
    return mapped(load_config(overrides={"domain": domain}), 2).snapshot()


@pytest.fixture
def context(ros: Ros) -> Iterator[Context]:
    """An initialised context in the test's domain."""
    result = Context()
    rclpy.init(context=result, domain_id=ros.domain)
    yield result
    result.try_shutdown()


@pytest.fixture
def node(context: Context) -> Node:
    """A node in it."""
    return Node("node", context=context)


@pytest.fixture
def executor(node: Node) -> Iterator[SingleThreadedExecutor]:
    """An executor of the node."""
    result = SingleThreadedExecutor(context=node.context)
    result.add_node(node)
    yield result
    result.shutdown()
