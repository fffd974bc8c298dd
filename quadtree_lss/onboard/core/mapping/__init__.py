# SPDX-License-Identifier: Apache-2.0
"""What a scan does to the map (paper III, IV)."""
