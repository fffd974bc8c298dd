# SPDX-License-Identifier: Apache-2.0
"""A simulated lander in closed loop with the nodes."""
