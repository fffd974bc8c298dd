# SPDX-License-Identifier: Apache-2.0
"""What proves it: simulation, flights, campaigns, evaluation against the truth."""
