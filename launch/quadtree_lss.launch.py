# SPDX-License-Identifier: Apache-2.0
"""The nodes: ``ros2 launch quadtree_lss quadtree_lss.launch.py params_file:=vehicle.yaml``."""

import os
import sys
from difflib import get_close_matches

import yaml
from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
)
from launch.event_handlers import OnProcessExit
from launch.events import matches_action
from launch.events.process import ProcessExited, ShutdownProcess
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

PACKAGE = "quadtree_lss"
# Exit codes after which another start would end the same way: wrong arguments, wrong configuration.
FINAL = (2, 78)
# What is said of the nodes that ended so.
ENDED: dict[str, str] = {}
# A launch of this file alone, which no other's nodes depend on, may end as failed.
ALONE = any(os.path.basename(word) == os.path.basename(__file__) for word in sys.argv[1:])
# Each is an argument too, with "_" for "/": the name under which the topic is known here.
TOPICS = {
    "mapping_node": (
        "lidar/points",
        "depth/image",
        "depth/camera_info",
        "lidar/gimbal",
        "nav/pose",
        "nav/odometry",
        "landing/area",
        "map/cells",
        "map/observed",
        "map/markers",
    ),
    "lss_node": (
        "map/cells",
        "map/observed",
        "nav/pose",
        "nav/odometry",
        "landing/area",
        "landing/keep_out",
        "landing/keep_outs",
        "landing/target",
        "landing/dispersion",
        "landing/sites",
        "landing/site_table",
        "landing/selected",
        "landing/status",
        "landing/hazards",
        "landing/score",
        "landing/probability",
        "landing/grid_map",
        "landing/markers",
    ),
    "autopilot_node": (
        "nav/odometry",
        "landing/area",
        "landing/dispersion",
        "landing/selected",
        "landing/status",
        "landing/autopilot",
    ),
}
# What `autopilot:=true` adds.
LANDS = "autopilot_node"


def generate_launch_description() -> LaunchDescription:
    """``mapping_node``, ``lss_node`` and, if it is asked for, ``autopilot_node`` with one parameter
    file, in one namespace."""
    arguments = {
        "params_file": ("", "ROS parameter file for all nodes; empty takes config"),
        "config": ("default", "shipped configuration, as in config:=drone"),
        "namespace": ("", "namespace of nodes and topics"),
        "use_sim_time": ("", "true or false: time from /clock; empty leaves it as it is set"),
        "log_level": ("", "debug, info, warn, error or fatal; empty leaves it as it is set"),
        "enclave": (
            "",
            "folder of the nodes' SROS 2 enclaves, as /quadtree_lss; empty = not given",
        ),
        "autopilot": ("false", "true: autopilot_node, which lands with a MAVLink autopilot, too"),
        "respawn": ("true", "start a node that has ended again, unless its configuration is wrong"),
    }
    for topic in sorted({topic for topics in TOPICS.values() for topic in topics}):
        arguments[_argument(topic)] = (topic, f"name of the topic {topic}")
    arguments["nav_odometry"] = (
        "nav/odometry",
        "topic of poses as nav_msgs/Odometry; if given, they are used instead of nav_pose",
    )
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text)
        for name, (value, text) in arguments.items()
    ]
    for word in sys.argv if ALONE else ():
        name, given, _ = word.partition(":=")
        if given and name not in arguments:
            near = get_close_matches(name, arguments, n=1)
            msg = f"there is no argument '{name}'"
            raise RuntimeError(f"{msg}; did you mean '{near[0]}'?" if near else msg)
    return LaunchDescription([*declared, OpaqueFunction(function=_nodes)])


def _nodes(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    def given(name: str) -> str:
        return LaunchConfiguration(name).perform(context)

    # Later ones win; what is not given here is left to the file and to a parent's SetParameter.
    named = f"{given('config')}.yaml"
    shipped = PathJoinSubstitution([FindPackageShare(PACKAGE), "config", named])
    parameters: list[object] = [_checked(given("params_file") or shipped.perform(context))]
    if given("use_sim_time"):
        parameters.append({"use_sim_time": _truth("use_sim_time", given("use_sim_time"))})
    sources: list[object] = []
    if given("nav_odometry") != "nav/odometry":
        sources = [{"pose.source": "odometry"}]
    log_level = ["--log-level", given("log_level")] if given("log_level") else []
    enclave = given("enclave").rstrip("/")
    entities: list[LaunchDescriptionEntity] = []
    lands = _truth("autopilot", given("autopilot"))
    started = {name: topics for name, topics in TOPICS.items() if lands or name != LANDS}
    for name, topics in started.items():
        node = Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=given("namespace"),
            parameters=[*parameters, *sources],
            remappings=[
                (topic, given(_argument(topic)))
                for topic in topics
                if given(_argument(topic)) != topic
            ],
            ros_arguments=[*log_level, *(["--enclave", f"{enclave}/{name}"] if enclave else [])],
            output="screen",
            respawn=_truth("respawn", given("respawn")),
            respawn_delay=1.0,
        )
        handler = OnProcessExit(
            target_action=node, on_exit=lambda *exited: _stay_ended(*exited, len(started))
        )
        entities += [RegisterEventHandler(handler), node]
    return entities


def _stay_ended(
    event: ProcessExited, context: LaunchContext, started: int
) -> list[LaunchDescriptionEntity]:
    """No respawn of a node that another start cannot help; the others go on.

    Raises:
        RuntimeError: there was such a node, and the last one has ended; the launch's exit code is
            then not 0.
    """
    final = event.returncode in FINAL
    if final:
        text = f"{event.process_name} ended with exit code {event.returncode}: its arguments or"
        text += " its configuration are wrong, see its line above; it is not started again"
        ENDED[event.action.name] = text
    respawn = _truth("respawn", LaunchConfiguration("respawn").perform(context))
    over = len(ENDED) == started or not (final or (respawn and not context.is_shutdown))
    if ENDED and over and ALONE:
        raise RuntimeError("; ".join(ENDED.values()))
    if not final:
        return []
    end = ShutdownProcess(process_matcher=matches_action(event.action))
    return [LogInfo(msg=text), EmitEvent(event=end)]


def _checked(path: str) -> str:
    """The parameter file's absolute path.

    Raises:
        RuntimeError: the nodes would not get a parameter from it, and fly with the defaults.
    """
    tried = os.path.abspath(os.path.expanduser(path))
    try:
        with open(tried, encoding="utf-8") as file:
            content = yaml.safe_load(file)
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        msg = f"params_file '{tried}' cannot be read: {reason}"
        raise RuntimeError(msg) from None
    if not content:
        msg = f"params_file '{tried}' is empty"
        raise RuntimeError(msg)
    return tried


def _truth(name: str, text: str) -> bool:
    if text.lower() not in ("true", "false"):
        msg = f"{name} is '{text}': it must be true or false"
        raise RuntimeError(msg)
    return text.lower() == "true"


def _argument(topic: str) -> str:
    return topic.replace("/", "_")
