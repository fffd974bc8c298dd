# SPDX-License-Identifier: Apache-2.0
"""Both nodes: ``ros2 launch quadtree_lss quadtree_lss.launch.py params_file:=vehicle.yaml``."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PACKAGE = "quadtree_lss"


def generate_launch_description() -> LaunchDescription:
    """``mapping_node`` and ``lss_node`` with one parameter file, in one namespace."""
    default = PathJoinSubstitution([FindPackageShare(PACKAGE), "config", "default.yaml"])
    arguments = [
        DeclareLaunchArgument(
            "params_file", default_value=default, description="ROS parameter file for both nodes"
        ),
        DeclareLaunchArgument(
            "namespace", default_value="", description="namespace of nodes and topics"
        ),
        DeclareLaunchArgument(
            "use_sim_time", default_value="false", description="take time from /clock"
        ),
        DeclareLaunchArgument(
            "lidar_points", default_value="lidar/points", description="topic of the scans"
        ),
        DeclareLaunchArgument(
            "nav_pose",
            default_value="nav/pose",
            description="topic of the lidar's poses, or of the body's with a mount",
        ),
        DeclareLaunchArgument(
            "lidar_gimbal",
            default_value="lidar/gimbal",
            description="topic of the gimbal, with mount.gimbal",
        ),
        DeclareLaunchArgument(
            "respawn", default_value="true", description="start a node that has ended again"
        ),
    ]
    sim_time = ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)
    shared = {
        "package": PACKAGE,
        "namespace": LaunchConfiguration("namespace"),
        "parameters": [LaunchConfiguration("params_file"), {"use_sim_time": sim_time}],
        "output": "screen",
        "respawn": LaunchConfiguration("respawn"),
        "respawn_delay": 1.0,
    }
    mapping = Node(
        executable="mapping_node",
        name="mapping_node",
        remappings=[
            ("lidar/points", LaunchConfiguration("lidar_points")),
            ("nav/pose", LaunchConfiguration("nav_pose")),
            ("lidar/gimbal", LaunchConfiguration("lidar_gimbal")),
        ],
        **shared,
    )
    lss = Node(executable="lss_node", name="lss_node", **shared)
    return LaunchDescription([*arguments, mapping, lss])
