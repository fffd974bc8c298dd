# SPDX-License-Identifier: Apache-2.0
"""Mapping and landing site selection on arrays: knows neither ROS nor files."""

from quadtree_lss import build

build.check()
