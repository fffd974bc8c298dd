# SPDX-License-Identifier: Apache-2.0
"""Sphere, rotations, planes, polygons and Morton order, independent of any map."""
