# SPDX-License-Identifier: Apache-2.0
"""Everything that a vehicle needs: configuration, core, messages, nodes and autopilot."""
