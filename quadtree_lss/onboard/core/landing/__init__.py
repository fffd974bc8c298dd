# SPDX-License-Identifier: Apache-2.0
"""Where the map allows landing, and the best of it (paper V)."""
