# SPDX-License-Identifier: Apache-2.0
"""The nodes: ``ros2 launch quadtree_lss quadtree_lss.launch.py params_file:=vehicle.yaml``."""

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

FINAL = (2, 78)  # exit codes for wrong arguments and configuration: another start ends likewise
ENDED: dict[str, str] = {}  # messages about nodes that ended so
ALONE = any(os.path.basename(word) == os.path.basename(__file__) for word in sys.argv[1:])
TOPICS = {  # each is an argument too, with "_" for "/"
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
    "params_file": ("", "ROS parameter file for all nodes; empty takes config"),
    "config": ("default", "shipped configuration, as in config:=drone"),
    "namespace": ("", "namespace of nodes and topics"),
    "use_sim_time": ("", "true or false: time from /clock; empty leaves it as it is set"),
    "log_level": ("", "debug, info, warn, error or fatal; empty leaves it as it is set"),
    "enclave": ("", "folder of the nodes' SROS 2 enclaves, as /quadtree_lss; empty = not given"),
    "autopilot": ("false", "true: autopilot_node, which lands with a MAVLink autopilot, too"),
    "respawn": ("true", "start a node that has ended again, unless its configuration is wrong"),
    **{t.replace("/", "_"): (t, "name of the topic") for t in " ".join(TOPICS.values()).split()},
    "nav_odometry": ("nav/odometry", "name of the topic; used instead of nav_pose if given"),
}


def generate_launch_description() -> LaunchDescription:
    """All nodes with one parameter file, in one namespace."""
    for word in sys.argv if ALONE else ():
        name, given, _ = word.partition(":=")
        if given and name not in ARGUMENTS:
            near = " or ".join(get_close_matches(name, ARGUMENTS, n=1)) or "--show-args"
            raise RuntimeError(f"there is no argument '{name}'; did you mean '{near}'?")
    declare, of = actions.DeclareLaunchArgument, ARGUMENTS.items()
    declared = [declare(name, default_value=v, description=text) for name, (v, text) in of]
    return LaunchDescription([*declared, actions.OpaqueFunction(function=_nodes)])


def _nodes(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    # Evaluated here: in an exit handler the scope of an including file is gone.
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    shipped = FindPackageShare("quadtree_lss").perform(context)
    path = given["params_file"] or os.path.join(shipped, "config", f"{given['config']}.yaml")
    parameters: list[object] = [_checked(path)]
    if given["use_sim_time"]:
        parameters.append({"use_sim_time": _truth(given, "use_sim_time")})
    if given["nav_odometry"] != "nav/odometry":
        parameters.append({"pose.source": "odometry"})
    words = ["--log-level", given["log_level"]] if given["log_level"] else []
    enclave, respawn = given["enclave"].rstrip("/"), _truth(given, "respawn")
    names = list(TOPICS)[: 3 if _truth(given, "autopilot") else 2]

    def ended(event: ProcessExited, context: LaunchContext) -> list[LaunchDescriptionEntity]:
        """No new start of a node that it cannot help; the launch fails after the last node."""
        final = event.returncode in FINAL
        text = f"{event.process_name} ended with exit code {event.returncode}: its arguments or"
        text += " its configuration are wrong, see its line above; it is not started again"
        ENDED.update({event.action.name: text} if final else {})
        over = len(ENDED) == len(names) or not (final or (respawn and not context.is_shutdown))
        if ENDED and over and ALONE:
            raise RuntimeError("; ".join(ENDED.values()))
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
        handler = OnProcessExit(target_action=node, on_exit=ended)
        entities += [actions.RegisterEventHandler(handler), node]
    return entities


def _checked(path: str) -> str:
    tried = os.path.abspath(os.path.expanduser(path))
    try:
        with open(tried, encoding="utf-8") as file:
            if yaml.safe_load(file):
                return tried
        reason = "is empty"  # the nodes would fly with the defaults
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = f"cannot be read: {getattr(error, 'strerror', '') or ' '.join(str(error).split())}"
    raise RuntimeError(f"params_file '{tried}' {reason}")


def _truth(given: dict[str, str], name: str) -> bool:
    if given[name].lower() not in ("true", "false"):
        raise RuntimeError(f"{name} is '{given[name]}': it must be true or false")
    return given[name].lower() == "true"
