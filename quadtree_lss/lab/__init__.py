# SPDX-License-Identifier: Apache-2.0
"""Simulation, flights, campaigns, and evaluation against the truth."""
