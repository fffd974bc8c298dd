# SPDX-License-Identifier: Apache-2.0
"""Sphere, rotations, planes, polygons: what does not know a map."""
