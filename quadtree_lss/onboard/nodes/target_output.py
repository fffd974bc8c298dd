# SPDX-License-Identifier: Apache-2.0
"""``landing/selected`` and ``landing/status``, said again before anybody misses them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from quadtree_lss.onboard.config.limits import LONGEST
from quadtree_lss.onboard.errors import QuadtreeLssError
from quadtree_lss.onboard.messages.outputs import SELECTED, STATUS
from quadtree_lss.onboard.nodes.executor import steady_timer
from quadtree_lss.onboard.nodes.qos import TARGET_S, advertise, latched, serve, target
from quadtree_lss.onboard.nodes.ros_messages import message_maker

if TYPE_CHECKING:
    from quadtree_lss.onboard.core.landing.result import LandingAssessment, Selected


class TargetOutput:
    """Publishes the target with every assessment, and between them while there is no new one.
    ``node``: owner; a change of the target goes to its log. ``age``: age of a map by its stamp, s;
    NaN if unknown. ``release``, ``land_now``: called when somebody asks for another target, or for
    the best within reach, which is then assessed and sent before the call returns."""

    def __init__(
        self,
        node: Node,
        age: Callable[[int], float],
        release: Callable[[], None],
        land_now: Callable[[], None],
    ) -> None:
        self._logger, self._age, self._release = node.get_logger(), age, release
        self._land_now, self._urgent = land_now, False
        self._publishers = {
            SELECTED: advertise(node, PoseWithCovarianceStamped, SELECTED, target()),
            STATUS: advertise(node, PointCloud2, STATUS, latched()),
        }
        self._result: LandingAssessment | None = None
        self._chosen = False
        self._frame = ""
        self._again = steady_timer(node, 0.4 * TARGET_S, self._say)
        serve(node, "release", self._on_release)
        serve(node, "land_now", self._on_land_now)

    def send(self, result: LandingAssessment, frame: str) -> None:
        """Publishes the target of an assessment.

        A node that has not decided yet says nothing of the target: "none" would withdraw the one
        of the node before it, if that was killed.
        """
        self._log_change(result)
        self._result, self._frame = result, frame
        self._chosen = self._chosen or not result.undecided
        self._again.reset()
        self._say()

    @contextmanager
    def held_up(self) -> Iterator[None]:
        """Within it a thread says the target again: a pass may take longer than the deadline.

        It ends after the longest that a pass may be configured to take: that one is stuck.
        """
        over = threading.Event()

        def say() -> None:
            for _ in range(int(LONGEST / (0.4 * TARGET_S))):
                if over.wait(0.4 * TARGET_S):
                    return
                self._say()

        thread = threading.Thread(target=say, daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()

    def _say(self) -> None:
        result = self._result
        if result is None:
            return
        maker, age = message_maker(self._frame), self._age(result.stamp_ns)
        for topic, message in maker.of_target(result, age):
            if topic == STATUS or self._chosen:
                self._publishers[topic].publish(message)

    def _log_change(self, result: LandingAssessment) -> None:
        """Log a change of the target, or of the reason why there is none."""
        selected, before = result.selected, self._result and self._result.selected
        last = before.id if before else 0
        if selected.id and selected.id != last:
            self._logger.info(f"{_text(selected)} ({result.why}): {selected.site.reasons[0]}")
        elif last and not selected.id:
            self._logger.warning(f"target {last} is withdrawn: {result.why}")
        elif not (selected.id or result.undecided or (before and before.reason == selected.reason)):
            self._logger.warning(result.why)

    def _on_release(self) -> str:
        before = self._result
        held = 0 if before is None else before.selected.id
        if not (held or self._urgent):
            msg = "there is no target"
            raise QuadtreeLssError(msg)
        self._urgent = False
        self._release()
        text = f"target {held} is released" if held else "landing now is not asked for any more"
        now = self._result
        if now is None or now is before:
            return f"{text}: the next map decides"
        chosen = now.selected
        return f"{text}: now {_text(chosen) if chosen.id else now.why}"

    def _on_land_now(self) -> str:
        self._urgent = True
        self._land_now()
        result = self._result
        if result is None or not result.selected.id:
            why = "nothing is mapped yet" if result is None else result.why
            msg = f"no place within reach ({why}); the first that there is will be it"
            raise QuadtreeLssError(msg)
        return f"{_text(result.selected)}, safe with probability {result.selected.probability:.3f}"


def _text(chosen: Selected) -> str:
    x, y, z = chosen.position
    return f"target {chosen.id} at x {x:.2f}, y {y:.2f}, z {z:.2f} m"
