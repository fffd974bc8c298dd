# SPDX-License-Identifier: Apache-2.0
"""Update of the map by scans (paper III, IV)."""
