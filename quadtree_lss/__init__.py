# SPDX-License-Identifier: Apache-2.0
"""Quadtree terrain mapping with planar cells and landing site selection."""

__version__ = "0.1.0"
