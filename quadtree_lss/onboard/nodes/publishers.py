# SPDX-License-Identifier: Apache-2.0
"""Topics that should have one publisher, and have several."""

from __future__ import annotations

from quadtree_lss.onboard.nodes.problems import Problems


class Publishers:
    """Counts the publishers of a topic and tells when there is more than one.

    Args:
        topic: Full name.
        reason: Under which it is counted.
        effect: What comes of it.
        problems: Where it is told.

    Attributes:
        number: Publishers that match at present.
    """

    def __init__(self, topic: str, reason: str, effect: str, problems: Problems) -> None:
        self.number = 0
        self._topic, self._reason, self._effect = topic, reason, effect
        self._problems = problems

    def changed(self, number: int) -> None:
        """Publishers came or went."""
        if number > max(self.number, 1):
            text = (
                f"{number} publishers on '{self._topic}': {self._effect} (one that was killed"
                " counts until its lease ends)"
            )
            self._problems.report(self._reason, text)
        self.number = number
