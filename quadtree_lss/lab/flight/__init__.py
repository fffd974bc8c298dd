# SPDX-License-Identifier: Apache-2.0
"""A simulated lander that flies by what the nodes say: vehicle, guidance, lidar, loop.

Uses the nodes' interface as an integrator would; nothing of the package needs this room.
"""
