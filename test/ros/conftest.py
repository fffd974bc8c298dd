# SPDX-License-Identifier: Apache-2.0
"""Nodes as real processes, each test in a ROS domain of its own on this computer alone."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

if importlib.util.find_spec("rclpy") is None:
    collect_ignore_glob = ["test_*.py"]
else:
    from quadtree_lss.ros.listener import Listener
    from quadtree_lss.ros.processes import NodeProcess, free_domain_id, local_environment

PARAMETERS = """\
/**:
  ros__parameters:
    domain: {xmin: -16.0, ymin: -16.0, size: 32.0, min_level: 3, max_level: 6}
    lidar: {range_noise: 0.03}
    lss: {grid_spacing: 0.5, sites: 3}
    qos: {scan_reliability: reliable}
    publish.diagnostics_rate: 5.0
"""


class Ros:
    """A domain with the processes and listeners of one test."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.domain = free_domain_id()
        self.folder = folder
        self.env = local_environment(self.domain, folder / "log")
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

    def listen(self) -> Listener:
        """Collects the nodes' topics, as a context manager."""
        return Listener(self.domain)


@pytest.fixture
def ros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ros]:
    """See `Ros`."""
    with ExitStack() as stack:
        session = Ros(tmp_path, stack)
        for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOG_DIR"):
            monkeypatch.setenv(name, session.env[name])
        yield session
