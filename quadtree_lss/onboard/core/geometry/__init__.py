# SPDX-License-Identifier: Apache-2.0
"""Sphere, rotations, planes, polygons, Morton order: what does not know a map."""
