# SPDX-License-Identifier: Apache-2.0
"""Scoring of results against simulated truth."""

from quadtree_lss import build

build.check()
