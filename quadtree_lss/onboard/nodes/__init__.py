# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 nodes: messages in, calls of the core, messages out. Only here is rclpy imported."""
