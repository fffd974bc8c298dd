# SPDX-License-Identifier: Apache-2.0
"""Playing of bags into running nodes; recording of live topics in memory."""
