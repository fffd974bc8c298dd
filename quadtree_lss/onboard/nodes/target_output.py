# SPDX-License-Identifier: Apache-2.0
"""Publication of ``landing/selected``, ``landing/status`` and ``landing/status_text``."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from quadtree_lss.onboard.config.limits import MAX_ASSESSMENT_S
from quadtree_lss.onboard.errors import QuadtreeLssError
from quadtree_lss.onboard.messages.outputs import SELECTED, STATUS, STATUS_TEXT
from quadtree_lss.onboard.nodes.diagnostics import OK, WARN
from quadtree_lss.onboard.nodes.qos import (
    TARGET_DEADLINE_S,
    advertise,
    latched,
    serve,
    steady_timer,
    target,
)
from quadtree_lss.onboard.nodes.ros_messages import message_maker

if TYPE_CHECKING:
    from quadtree_lss.onboard.core.landing.result import LandingAssessment, Selected

REPEAT_S = 0.4 * TARGET_DEADLINE_S
"""Period of repeating the target: two repetitions fit into the deadline."""


class TargetOutput:
    """Publish the target with every assessment, and repeat it until the next one. ``age`` returns
    the age of a map by its stamp, s, or NaN. ``release`` and ``land_now`` select another target, or
    the best one within reach, and assess and publish before they return."""

    def __init__(
        self,
        node: Node,
        age: Callable[[int], float],
        release: Callable[[], None],
        land_now: Callable[[], None],
    ) -> None:
        self._logger, self._age = node.get_logger(), age
        self._release, self._land_now = release, land_now
        self._selected = advertise(node, PoseWithCovarianceStamped, SELECTED, target())
        self._status = advertise(node, PointCloud2, STATUS, latched())
        self._status_text = advertise(node, DiagnosticStatus, STATUS_TEXT, latched())
        self._result: LandingAssessment | None = None
        self._frame = ""
        self._decided = self._landing_now = False
        self._timer = steady_timer(node, REPEAT_S, self._publish)
        serve(node, "release", self._on_release)
        serve(node, "land_now", self._on_land_now)

    def send(self, result: LandingAssessment, frame: str) -> None:
        """Publish the target of an assessment; "no target" only after the first decision, because
        a restarted node would withdraw the target of the killed one."""
        self._log_change(result)
        self._result, self._frame = result, frame
        self._decided = self._decided or not result.undecided
        self._timer.reset()
        self._publish()

    @contextmanager
    def repeated(self) -> Iterator[None]:
        """Repeat the target in a thread, because an assessment can take longer than the deadline;
        at most for the longest time of an assessment that parameters allow."""
        done = threading.Event()

        def repeat() -> None:
            for _ in range(int(MAX_ASSESSMENT_S / REPEAT_S)):
                if done.wait(REPEAT_S):
                    return
                self._publish()

        thread = threading.Thread(target=repeat, daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()

    def _publish(self) -> None:
        result = self._result
        if result is None:
            return
        age = self._age(result.stamp_ns)
        messages = dict(message_maker(self._frame).of_target(result, age))
        if self._decided:
            self._selected.publish(messages[SELECTED])
        self._status.publish(messages[STATUS])
        self._status_text.publish(status_text(result, age))

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
        held = before.selected.id if before else 0
        if not (held or self._landing_now):
            msg = "there is no target"
            raise QuadtreeLssError(msg)
        self._landing_now = False
        self._release()
        text = f"target {held} is released" if held else "landing now is cancelled"
        now = self._result
        if now is None or now is before:
            return f"{text}: the next map decides"
        return f"{text}: now {_text(now.selected) if now.selected.id else now.why}"

    def _on_land_now(self) -> str:
        self._landing_now = True
        self._land_now()
        result = self._result
        if result is None or not result.selected.id:
            why = "nothing is mapped yet" if result is None else result.why
            msg = f"no place within reach ({why}); the first one will be the target"
            raise QuadtreeLssError(msg)
        return f"{_text(result.selected)}, safe with probability {result.selected.probability:.3f}"


def status_text(result: LandingAssessment, age: float) -> DiagnosticStatus:
    """Make ``landing/status_text``: ``landing/status`` as text, for people, plots and C++ nodes."""
    selected = result.selected
    status = DiagnosticStatus(level=OK if selected.id else WARN, name="target", message=result.why)
    values: dict[str, object] = {
        "id": selected.id,
        "state": selected.state.name.lower(),
        "reason": selected.reason.key,
        "probability": f"{selected.probability:.5f}",
        "age": f"{age:.3f}",
        "seen": f"{result.seen:.4f}",
        "offset_z": f"{result.offset_z:.3f}",
        "answer": result.number,
    }
    if selected.id:
        x, y, z = selected.position
        values |= {"x": f"{x:.3f}", "y": f"{y:.3f}", "z": f"{z:.3f}"}
        values["hazard_distance"] = f"{selected.site.hazard_distance[0]:.2f}"
    status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return status


def _text(selected: Selected) -> str:
    x, y, z = selected.position
    return f"target {selected.id} at x {x:.2f}, y {y:.2f}, z {z:.2f} m"
