# SPDX-License-Identifier: Apache-2.0
"""Lidar measurements, poses, and the registration of scans in the map frame."""
