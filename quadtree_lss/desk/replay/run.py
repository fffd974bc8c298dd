# SPDX-License-Identifier: Apache-2.0
"""Mapping of the scans of a bag, or reading of its maps."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Any

from quadtree_lss.desk.bags.bag import Bag
from quadtree_lss.desk.bags.recorded_file import RawMessage
from quadtree_lss.desk.replay.assessments import Assessments
from quadtree_lss.desk.replay.files import ReplayError
from quadtree_lss.desk.replay.history import History
from quadtree_lss.desk.replay.results import ScanTiming, points_warning
from quadtree_lss.desk.replay.stream import LandingTopics, MapPairs, Part, Progress, Stream
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.mapping.mapper import GAP_SCANS, Mapper
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.errors import one_line
from quadtree_lss.onboard.messages import lost_points
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.intake import Notice, ReadyScan, noise_notice, pose_notice
from quadtree_lss.onboard.messages.landing_inputs import AREA


class Run:
    """Processes a part of an open bag.

    ``assessments`` gets the maps, ``landing`` the areas, keep-outs and targets, ``history`` the
    scans. If ``stop`` returns True after a message, the run is ``interrupted``. ``done_ns``: time
    of reception of the last message; ``points_dropped``: points of mapped scans that are not in
    the map, by reason; ``maps``: number of maps read.
    """

    def __init__(
        self,
        bag: Bag,
        part: Part,
        config: Config,
        assessments: Assessments,
        landing: LandingTopics,
        history: History,
        progress: Progress | None = None,
        stop: Callable[[], bool] | None = None,
    ) -> None:
        self.config, self.assessments = config, assessments
        self._bag, self._part, self._landing, self._history = bag, part, landing, history
        self._progress, self._stop = progress, stop
        self.interrupted, self.done_ns, self.maps = False, 0, 0
        self.timings: list[ScanTiming] = []
        self.points_dropped: Counter[str] = Counter()
        self._refused_divisions, self._noise_ratio = 0, float("nan")
        self._notices: Counter[str] = Counter()
        self._texts: dict[str, str] = {}
        self._pose_text = ""
        self._decode_ms: dict[int, float] = {}
        self._missed_at: tuple[float, float] | None = None

    def map_scans(self, stream: Stream) -> CellMap:
        """Map the scans of a stream; return the last map. Raises `ReplayError`: no scan could be
        mapped; KeyboardInterrupt: stopped before the first one."""
        mapper = Mapper(self.config)
        intake = stream.intake
        stream.on_message = self._navigate
        for message in self._messages(stream.topics):
            began = time.perf_counter()
            stamp_ns = stream.process(message)
            if stamp_ns is not None:
                self._decode_ms[stamp_ns] = 1e3 * (time.perf_counter() - began)
            for scan in intake.ready(message.received_ns):
                self._map(mapper, scan)
                self.assessments.changed()
            self._add_notices(intake.notices())
            self.assessments.tick(message.received_ns, mapper.snapshot)
        intake.finish()
        self._add_notices(intake.notices())
        self._check_poses(mapper)
        if not self.timings:
            raise self._failure("no scan could be mapped", "there is no scan")
        return mapper.snapshot()

    def read_maps(self, pairs: MapPairs) -> CellMap:
        """Read a bag of maps; return the last one. Raises as `map_scans`."""
        last: CellMap | None = None
        for message in self._messages(pairs.topics):
            try:
                found = pairs.add(self._bag, message, self.config.lss)
            except MessageError as error:
                self._add_notice(f"map_{error.reason}", str(error))
                found = None
            if found is not None:
                last, self.maps = found, self.maps + 1
                self.assessments.changed()
            self._add_notices()
            if last is not None:
                self.assessments.tick(message.received_ns, lambda newest=last: newest)
        if last is None:
            raise self._failure("no map can be read", "no map/cells with map/observed")
        return last

    def _messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Yield messages of the topics until the run stops; landing topics are handled here."""
        wanted = [*topics, *self._landing.names]
        for message in self._part.messages(self._bag, wanted, self._progress):
            if self._landing.process(self._bag, message):
                self.assessments.landing_changed()
                continue
            yield message
            self.done_ns = message.received_ns
            self.interrupted = self._stop is not None and self._stop()
            if self.interrupted:
                return

    @property
    def points(self) -> int:
        return sum(row.points for row in self.timings)

    def counts(self) -> dict[str, Any]:
        """Entries of ``summary.json``."""
        return {
            "points_used": self.points - self.points_dropped.total(),
            "points_dropped": dict(self.points_dropped),
            "maps": self.maps,
            "range_noise_ratio": self._noise_ratio,
            "refused_divisions": self._refused_divisions,
            "interrupted": self.interrupted,
        }

    def warnings(self) -> list[str]:
        """One line for each kind of problem, most frequent first."""
        lost, domain = self.points_dropped, Domain.of(self.config.domain)
        refused = self._refused_divisions
        noise = noise_notice(self._noise_ratio, self.config)
        lines = [
            points_warning(self.points, lost, domain, self._missed_at),
            *(f"{n} x {key}: {self._texts[key]}" for key, n in self._notices.most_common()),
            f"{refused} divisions refused (mapping.max_cells)" if refused else "",
            self._pose_text,
            "" if noise is None else noise.text,
        ]
        return list(filter(None, lines))

    def _failure(self, failure: str, default: str) -> BaseException:
        causes = "; ".join(self.warnings()) or f"{default} in this part of the bag"
        text = f"{self._bag.path}: {failure}: {causes}"
        return KeyboardInterrupt() if self.interrupted else ReplayError(text)

    def _map(self, mapper: Mapper, scan: ReadyScan) -> None:
        mapper.look_at(self._landing.requests.values[AREA])
        began = time.perf_counter()
        report = mapper.update(scan.points_lidar, scan.pose, scan.sweep)
        map_ms = 1e3 * (time.perf_counter() - began) + self._decode_ms.pop(scan.stamp_ns, 0.0)
        if len(self._decode_ms) > 2 * self.config.pose.queue:
            self._decode_ms.clear()  # those of dropped scans
        self._history.scan(scan)
        self.points_dropped.update(scan.lost(report.dropped))
        if lost_points.misplaced(report):
            self._missed_at = self._missed_at or report.centre
        overruled = lost_points.overruled_text(report)
        if overruled is not None:
            self._add_notice(lost_points.MAP_OVERRULED, overruled)
        self._refused_divisions += report.refused_divisions
        self._noise_ratio = report.noise_ratio
        if len(self.timings) % GAP_SCANS == 0:
            self._check_poses(mapper)
        counts = report.points, report.points_used, report.leaves, report.divisions
        self.timings.append(ScanTiming(report.stamp_ns, *counts, map_ms))

    def _navigate(self, what: str, msg: Any, _: RawMessage) -> None:
        if what == "pose":
            self._landing.requests.navigation.use_pose(msg)

    def _check_poses(self, mapper: Mapper) -> None:
        notice = pose_notice(mapper.pose_gap())
        self._pose_text = self._pose_text if notice is None else notice.text

    @property
    def losses(self) -> list[str]:
        """One line for each kind of message that could not be decoded, except those of `Stream`."""
        keys = [key for key in self._notices if key.endswith("_encoding")]
        own = [key for key in keys if not key.startswith(("cloud", "pose", "gimbal"))]
        return [one_line(f"{self._notices[key]} messages lost: {self._texts[key]}") for key in own]

    def _add_notices(self, notices: Iterable[Notice] = ()) -> None:
        for notice in (*notices, *self._landing.notices):
            self._add_notice(notice.reason, notice.text)
        self._landing.notices.clear()

    def _add_notice(self, reason: str, text: str) -> None:
        self._notices[reason] += 1
        self._texts.setdefault(reason, text)
