# SPDX-License-Identifier: Apache-2.0
"""Domain, the table of leaves, the published map."""
