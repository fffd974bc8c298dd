# SPDX-License-Identifier: Apache-2.0
"""Scans that were sent but lost on the way, which nothing else would tell."""

from __future__ import annotations

from quadtree_lss.onboard.nodes.problems import Problems
from quadtree_lss.onboard.nodes.publishers import Publishers


class ScanGaps:
    """Looks for gaps in the numbers that a publisher gives its messages.

    Two publishers number theirs apart, and a message does not say whose it is: while there are
    two, gaps cannot be found, and that there are two is a problem of its own.

    Args:
        topic: Full name.
        problems: Where losses are counted as ``scan_lost``.
    """

    def __init__(self, topic: str, problems: Problems) -> None:
        self._topic = topic
        self._problems = problems
        effect = "their scans are mapped as they come, as if of one lidar"
        self._publishers = Publishers(topic, "scan_publishers", effect, problems)
        self._last = 0

    def on_publishers(self, number: int) -> None:
        """Publishers came or went."""
        self._publishers.changed(number)
        self._last = 0

    def on_scan(self, number: int) -> None:
        """A scan arrived with this number."""
        last, self._last = self._last, number
        missing = number - last - 1
        if last > 0 and missing > 0 and self._publishers.number <= 1:
            text = (
                f"{missing} scans on '{self._topic}' were lost before number {number}: best"
                " effort, or more than the middleware queues (50) were waiting"
            )
            self._problems.report("scan_lost", text, missing)
