# SPDX-License-Identifier: Apache-2.0
"""Recorded bags through the same code as the nodes, without ROS."""
