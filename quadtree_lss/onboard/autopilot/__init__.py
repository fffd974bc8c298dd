# SPDX-License-Identifier: Apache-2.0
"""Landing with an autopilot: frames, state machine, MAVLink link. Independent of ROS."""
