# SPDX-License-Identifier: Apache-2.0
"""Simulated descents over known terrain, written as ROS 2 bags; no code in common with mapping."""

from quadtree_lss import build

build.check()
