# SPDX-License-Identifier: Apache-2.0
"""Playing a bag into running nodes; listening to live topics."""
