# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 nodes: they convert messages and call the core. Only this package imports rclpy."""
