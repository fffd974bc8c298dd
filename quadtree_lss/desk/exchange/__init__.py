# SPDX-License-Identifier: Apache-2.0
"""Read files: point clouds, poses and elevation models of other programs; results folders."""
