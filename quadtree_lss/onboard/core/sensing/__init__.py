# SPDX-License-Identifier: Apache-2.0
"""Lidar, poses, and a scan on its way into the map frame."""
