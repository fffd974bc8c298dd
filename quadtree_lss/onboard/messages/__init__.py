# SPDX-License-Identifier: Apache-2.0
"""Message layouts to and from arrays, without ROS: serves live nodes and replay alike."""
