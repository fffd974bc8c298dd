# SPDX-License-Identifier: Apache-2.0
"""Domain, Morton order, the table of leaves, the published map."""
