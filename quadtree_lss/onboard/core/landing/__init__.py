# SPDX-License-Identifier: Apache-2.0
"""Assessment of landing sites (paper V)."""
