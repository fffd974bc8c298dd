# SPDX-License-Identifier: Apache-2.0
"""Recordings as streams of messages: bags of ROS 2 and ROS 1, files of point clouds."""
