# SPDX-License-Identifier: Apache-2.0
"""What people do with recordings: replay, results in other forms, reports, commands."""
