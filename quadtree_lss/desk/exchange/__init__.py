# SPDX-License-Identifier: Apache-2.0
"""Files that are read: other programs' point clouds and poses, and results folders."""
