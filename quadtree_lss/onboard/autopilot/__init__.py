# SPDX-License-Identifier: Apache-2.0
"""Landing by an autopilot: frames, the decision at each moment, MAVLink. No ROS in here."""
