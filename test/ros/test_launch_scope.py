# SPDX-License-Identifier: Apache-2.0
"""The launch file, included by a vehicle's own with a foreign node, run by ROS's `launch`."""

import importlib.util
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import psutil
import pytest
from installed import PREFIX, SHARE

pytestmark = [
    pytest.mark.xdist_group("launch"),
    pytest.mark.skipif(
        importlib.util.find_spec("launch_ros") is None, reason="launch_ros is not installed"
    ),
]

FILE = SHARE / "launch" / "quadtree_lss.launch.py"
FOREIGN = "import time; time.sleep(1000)"
PARENTS = {
    "py": """
from launch import LaunchDescription
from launch.actions import ExecuteProcess, GroupAction, IncludeLaunchDescription
from launch_ros.actions import PushRosNamespace

def generate_launch_description():
    arguments = {{"params_file": "{params}", "respawn": "true"}}.items()
    nodes = IncludeLaunchDescription("{file}", launch_arguments=arguments)
    foreign = ExecuteProcess(cmd=["{python}", "-c", "{foreign}"])
    return LaunchDescription([foreign, GroupAction([PushRosNamespace("vehicle"), nodes])])
""",
    "xml": """
<launch>
  <executable cmd="{python} -c '{foreign}'" output="screen"/>
  <group>
    <push_ros_namespace namespace="vehicle"/>
    <include file="{file}">
      <arg name="params_file" value="{params}"/>
    </include>
  </group>
</launch>
""",
}
RUN = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import AnyLaunchDescriptionSource

service = LaunchService()
source = AnyLaunchDescriptionSource(sys.argv[1])
service.include_launch_description(LaunchDescription([IncludeLaunchDescription(source)]))
sys.exit(service.run())
"""


class Launch:
    """Running launch of a parent file, with its output and processes."""

    def __init__(self, process: subprocess.Popen[bytes], log) -> None:
        self.process, self._log = process, log

    def output(self) -> str:
        return self._log.read_text(encoding="utf-8")

    def pid(self, word: str) -> int:
        """Return the process id of the child with a word in its command line, or 0."""
        for child in psutil.Process(self.process.pid).children(recursive=True):
            try:
                if word in " ".join(child.cmdline()) and child.status() != psutil.STATUS_ZOMBIE:
                    return child.pid
            except psutil.Error:
                continue
        return 0

    def until(self, condition) -> None:
        end = time.monotonic() + 60.0
        while not condition():
            assert self.process.poll() is None and time.monotonic() < end, self.output()
            time.sleep(0.1)


@pytest.fixture(params=PARENTS)
def launch(request, ros, tmp_path):
    @contextmanager
    def running(parameters: str):
        params = tmp_path / "params.yaml"
        params.write_text(f"/**:\n  ros__parameters:\n    {parameters}\n")
        parent = tmp_path / f"vehicle.launch.{request.param}"
        values = {"params": params, "file": FILE, "python": sys.executable, "foreign": FOREIGN}
        parent.write_text(PARENTS[request.param].format(**values).lstrip())
        prefixes = [str(PREFIX), *filter(None, [os.environ.get("AMENT_PREFIX_PATH")])]
        env = {**ros.env, "AMENT_PREFIX_PATH": os.pathsep.join(prefixes)}
        env["ROS_LOG_DIR"] = str(tmp_path / "log")
        log = tmp_path / "output.txt"
        with log.open("wb") as out:
            process = subprocess.Popen(
                [sys.executable, "-c", RUN, str(parent)],
                env=env,
                cwd=tmp_path,
                stdout=out,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            try:
                yield Launch(process, log)
                process.send_signal(signal.SIGINT)
                assert process.wait(30.0) == 0, log.read_text(encoding="utf-8")
            finally:
                if process.poll() is None:
                    os.killpg(process.pid, signal.SIGKILL)
                    process.wait()

    return running


def test_killed_node_is_restarted_and_foreign_ones_continue(launch):
    with launch("lss.margin: 1.0") as running:
        running.until(lambda: running.pid("lss_node") and running.pid("time.sleep"))
        killed, foreign = running.pid("lss_node"), running.pid("time.sleep")
        os.kill(killed, signal.SIGKILL)
        running.until(lambda: running.pid("lss_node") not in (0, killed))
        assert running.pid("time.sleep") == foreign and running.pid("mapping_node")
        assert "__ns:=/vehicle" in running.output() or running.pid("__ns:=/vehicle")


def test_wrong_configuration_stops_only_its_nodes(launch):
    with launch("lss.margn: 1.0") as running:
        running.until(lambda: running.output().count("it is not started again") == 2)
        running.until(lambda: not running.pid("lss_node") and not running.pid("mapping_node"))
        time.sleep(2.0)  # longer than the respawn delay
        assert not running.pid("lss_node") and running.pid("time.sleep")
        assert "exit code 78" in running.output() and running.process.poll() is None
