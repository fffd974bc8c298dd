# SPDX-License-Identifier: Apache-2.0
"""What can be read off the figures."""

from __future__ import annotations

import numpy as np

from quadtree_lss.lab.evaluation.figures import processing_time


def test_scans_are_counted_in_whole_numbers():
    axes = processing_time({"run": np.array([1.0, 2.0, 1.5])}).axes[0]
    ticks = axes.get_xticks()
    np.testing.assert_array_equal(ticks, np.round(ticks))
