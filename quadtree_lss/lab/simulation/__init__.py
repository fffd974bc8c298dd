# SPDX-License-Identifier: Apache-2.0
"""Simulated descents over known terrain as ROS 2 bags; shares no code with mapping."""

from quadtree_lss import build

build.check()
