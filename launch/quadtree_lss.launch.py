# SPDX-License-Identifier: Apache-2.0
"""Launch file: `ros2 launch quadtree_lss quadtree_lss.launch.py params_file:=vehicle.yaml`."""

import os
import sys
from difflib import get_close_matches

import yaml
from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity, actions
from launch.event_handlers import OnProcessExit
from launch.events.process import ProcessExited, ShutdownProcess
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

FINAL_CODES = (2, 78)  # wrong arguments or configuration: a restart cannot help
FAILED_NODES: dict[str, str] = {}  # messages of nodes that exited with one of them
IS_TOP_LEVEL = any(os.path.basename(word) == os.path.basename(__file__) for word in sys.argv[1:])
TOPICS = {  # also launch arguments, with "_" for "/"
    "mapping_node": "lidar/points depth/image depth/camera_info lidar/gimbal nav/pose nav/odometry"
    " landing/area map/cells map/observed map/markers",
    "lss_node": "map/cells map/observed nav/pose nav/odometry landing/area landing/keep_out"
    " landing/keep_outs landing/target landing/dispersion landing/sites landing/site_table"
    " landing/selected landing/status landing/status_text landing/hazards landing/score"
    " landing/probability landing/grid_map landing/markers",
    "autopilot_node": "nav/odometry landing/area landing/dispersion landing/selected"
    " landing/status landing/autopilot",
}
ARGUMENTS = {
    "params_file": ("", "ROS parameter file for all nodes; empty uses config"),
    "config": ("default", "configuration of the package, as in config:=drone"),
    "namespace": ("", "namespace of nodes and topics"),
    "use_sim_time": ("", "true or false: time from /clock; empty does not set it"),
    "log_level": ("", "debug, info, warn, error or fatal; empty does not set it"),
    "enclave": ("", "folder of the nodes' SROS 2 enclaves, such as /quadtree_lss; empty for none"),
    "autopilot": ("false", "true: also start autopilot_node, which lands with a MAVLink autopilot"),
    "respawn": ("true", "restart a node that exited, unless its configuration is wrong"),
    **{t.replace("/", "_"): (t, "name of the topic") for t in " ".join(TOPICS.values()).split()},
    "nav_odometry": ("nav/odometry", "name of the topic; used instead of nav_pose if given"),
}


def generate_launch_description() -> LaunchDescription:
    """Start all nodes with one parameter file, in one namespace."""
    for word in sys.argv if IS_TOP_LEVEL else ():
        name, separator, _ = word.partition(":=")
        if separator and name not in ARGUMENTS:
            near = " or ".join(get_close_matches(name, ARGUMENTS, n=1)) or "--show-args"
            raise RuntimeError(f"there is no argument '{name}'; did you mean '{near}'?")
    declared = [
        actions.DeclareLaunchArgument(name, default_value=value, description=text)
        for name, (value, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, actions.OpaqueFunction(function=_nodes)])


def _nodes(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    # Evaluated here, because an exit handler has no access to the scope of an including file.
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    shipped = FindPackageShare("quadtree_lss").perform(context)
    path = given["params_file"] or os.path.join(shipped, "config", f"{given['config']}.yaml")
    parameters: list[object] = [_checked(path)]
    if given["use_sim_time"]:
        parameters.append({"use_sim_time": _boolean(given, "use_sim_time")})
    if given["nav_odometry"] != "nav/odometry":
        parameters.append({"pose.source": "odometry"})
    words = ["--log-level", given["log_level"]] if given["log_level"] else []
    enclave, respawn = given["enclave"].rstrip("/"), _boolean(given, "respawn")
    names = list(TOPICS)[: 3 if _boolean(given, "autopilot") else 2]

    def on_exit(event: ProcessExited, context: LaunchContext) -> list[LaunchDescriptionEntity]:
        """Do not restart a node after one of `FINAL_CODES`; fail the launch after the last node."""
        final = event.returncode in FINAL_CODES
        text = f"{event.process_name} ended with exit code {event.returncode}: its arguments or"
        text += " its configuration are wrong, see its line above; it is not started again"
        FAILED_NODES.update({event.action.name: text} if final else {})
        continues = final or (respawn and not context.is_shutdown)
        over = len(FAILED_NODES) == len(names) or not continues
        if FAILED_NODES and over and IS_TOP_LEVEL:
            raise RuntimeError("; ".join(FAILED_NODES.values()))
        end = ShutdownProcess(process_matcher=lambda action: action is event.action)
        return [actions.LogInfo(msg=text), actions.EmitEvent(event=end)] if final else []

    entities: list[LaunchDescriptionEntity] = []
    for name in names:
        topics = {topic: given[topic.replace("/", "_")] for topic in TOPICS[name].split()}
        node = Node(
            package="quadtree_lss", executable=name, name=name, namespace=given["namespace"],
            parameters=parameters, remappings=[(k, v) for k, v in topics.items() if k != v],
            ros_arguments=words + (["--enclave", f"{enclave}/{name}"] if enclave else []),
            output="screen", respawn=respawn, respawn_delay=1.0,
        )  # fmt: skip
        handler = OnProcessExit(target_action=node, on_exit=on_exit)
        entities += [actions.RegisterEventHandler(handler), node]
    return entities


def _checked(path: str) -> str:
    full_path = os.path.abspath(os.path.expanduser(path))
    try:
        with open(full_path, encoding="utf-8") as file:
            if yaml.safe_load(file):
                return full_path
        reason = "is empty"  # the nodes would run with the defaults
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = f"cannot be read: {getattr(error, 'strerror', '') or ' '.join(str(error).split())}"
    raise RuntimeError(f"params_file '{full_path}' {reason}")


def _boolean(given: dict[str, str], name: str) -> bool:
    if given[name].lower() not in ("true", "false"):
        raise RuntimeError(f"{name} is '{given[name]}': it must be true or false")
    return given[name].lower() == "true"
