# SPDX-License-Identifier: Apache-2.0
"""A map made from the scans of a bag, or read from a bag of maps."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from quadtree_lss.desk.bags.bag import Bag
from quadtree_lss.desk.bags.recorded_file import RawMessage
from quadtree_lss.desk.replay.history import History
from quadtree_lss.desk.replay.passes import Passes
from quadtree_lss.desk.replay.points import points_warning
from quadtree_lss.desk.replay.result import ScanTiming
from quadtree_lss.desk.replay.stream import SECOND_NS, LandingTopics, MapPairs, ReplayError, Stream
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.mapping.pose_errors import LEAST
from quadtree_lss.onboard.core.mapping.prior_offset import PriorOffset
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.core.tree.prior import Prior
from quadtree_lss.onboard.errors import one_line
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.intake import Intake, ReadyScan, noise_notice, pose_notices
from quadtree_lss.onboard.messages.landing_inputs import AREA
from quadtree_lss.onboard.messages.lost_points import (
    MAP_OVERRULED,
    likely_reason,
    misplaced,
    overruled_text,
)

Progress = Callable[[float, float], None]
"""Called with the seconds of the bag that are done and the seconds there are."""


@dataclass
class Run:
    """What has been done so far.

    Args:
        config: Everything that can be set.
        stream: What is read.
        passes: Gets the maps as they come.
        landing: Hears areas, keep-outs and targets as they come.
        history: Notes where the lidar looked.
        progress: See `Progress`.
        stop: Asked after each message; True ends the run there, which is then ``interrupted``.

    Attributes:
        done_ns: Time of reception up to which the bag was processed.
        timings: A row per mapped scan.
        points_dropped: Points of mapped scans that are not in the map, by reason.
        refused_divisions: Cells that ``mapping.max_cells`` left whole.
        maps: Maps that were read, for a bag of maps.
        prior: What leaves begin from; ``prior_offset`` is how far the map lay from it at the end.
    """

    config: Config
    stream: Stream
    passes: Passes
    landing: LandingTopics
    history: History
    progress: Progress | None = None
    stop: Callable[[], bool] | None = None
    interrupted: bool = False
    done_ns: int = 0
    timings: list[ScanTiming] = field(default_factory=list)
    points_dropped: Counter[str] = field(default_factory=Counter)
    refused_divisions: int = 0
    noise_ratio: float = float("nan")
    maps: int = 0
    prior: Prior | None = None
    prior_offset: PriorOffset | None = None

    def __post_init__(self) -> None:
        self.intake = Intake(self.config)
        self._notices: Counter[str] = Counter()
        self._texts: dict[str, str] = {}
        self._pose_texts: dict[str, str] = {}
        self._decode_ms: dict[int, float] = {}
        self._missed_at: tuple[float, float] | None = None
        self._missed_why = ""
        self._shown_ns = 0

    def map_scans(self, bag: Bag) -> CellMap:
        """Maps every scan of the stream. Raises `ReplayError`: there was none that could be mapped;
        or KeyboardInterrupt: stopped before there was one."""
        stream, mapper = self.stream, Mapper(self.config, self.prior)
        self.intake = stream.intake(self.config)
        for message in self._messages(bag, stream.topics):
            began = time.perf_counter()
            stamp_ns = stream.take(bag, self.intake, message)
            if stamp_ns is not None:
                self._decode_ms[stamp_ns] = 1e3 * (time.perf_counter() - began)
            for scan in self.intake.ready(message.received_ns):
                self._map(mapper, scan)
                self.passes.changed()
            self._note()
            self.passes.tick(message.received_ns, mapper.snapshot)
            if self._ends_after(message.received_ns):
                break
        self.intake.finish()
        self._note()
        self._judge_poses(mapper)
        self.prior_offset = mapper.prior_offset
        self._need(bool(self.timings), bag, "no scan could be mapped", "there is no scan")
        return mapper.snapshot()

    def read_maps(self, bag: Bag, pairs: MapPairs) -> CellMap:
        """The last map of a bag of maps; the landing passes get all of them. Raises as
        `map_scans`."""
        last: CellMap | None = None
        for message in self._messages(bag, pairs.topics):
            try:
                found = pairs.take(bag, message, self.config.lss)
            except MessageError as error:
                self._tell(f"map_{error.reason}", str(error))
                found = None
            if found is not None:
                last, self.maps = found, self.maps + 1
                self.passes.changed()
            self._note()
            if last is not None:
                newest = last
                self.passes.tick(message.received_ns, lambda: newest)  # noqa: B023
            if self._ends_after(message.received_ns):
                break
        self._need(last is not None, bag, "no map can be read", "no cells with observed cells")
        assert last is not None
        return last

    def _messages(self, bag: Bag, topics: Iterable[str]) -> Iterator[RawMessage]:
        """Those of the topics; what is asked of landing goes where it is heard."""
        limits = self.stream.start_ns, self.stream.stop_ns
        for message in bag.messages([*topics, *self.landing.names], *limits):
            if self.landing.take(bag, message):
                self.passes.landing_changed()
            else:
                yield message

    @property
    def points(self) -> int:
        """Points of the mapped scans."""
        return sum(row.points for row in self.timings)

    @property
    def points_used(self) -> int:
        """Those of them that entered the map."""
        return self.points - sum(self.points_dropped.values())

    def _lost_points(self) -> str | None:
        """Why less than half of the points entered the map; None if more did."""
        lost, domain = self.points_dropped, Domain.of(self.config.domain)
        return points_warning(self.points, lost, domain, self._missed_at, self._missed_why)

    def warnings(self) -> list[str]:
        """One line per kind of trouble, most frequent first."""
        lines = list(filter(None, [self._lost_points()]))
        lines += [f"{n} x {key}: {self._texts[key]}" for key, n in self._notices.most_common()]
        if self.refused_divisions:
            lines.append(f"{self.refused_divisions} divisions refused (mapping.max_cells)")
        lines += self._pose_texts.values()
        if self.prior_offset is not None and self.prior_offset.doubt:
            lines.append(self.prior_offset.doubt)
        noise = noise_notice(self.noise_ratio, self.config)
        if noise is not None:
            lines.append(noise.text)
        return lines

    def _need(self, found: bool, bag: Bag, failure: str, default: str) -> None:
        if found:
            return
        if self.interrupted:
            raise KeyboardInterrupt
        causes = "; ".join(self.warnings()) or f"{default} in this part of the bag"
        raise ReplayError(f"{bag.path}: {failure}: {causes}")

    def _ends_after(self, received_ns: int) -> bool:
        self.done_ns = received_ns
        if self.progress is not None and received_ns - self._shown_ns >= SECOND_NS // 5:
            self._shown_ns = received_ns
            done = (received_ns - self.stream.start_ns) / SECOND_NS
            self.progress(done, self.stream.seconds)
        self.interrupted = self.stop is not None and self.stop()
        return self.interrupted

    def _map(self, mapper: Mapper, scan: ReadyScan) -> None:
        mapper.look_at(self.landing.wishes.values[AREA])
        began = time.perf_counter()
        report = mapper.update(scan.points_lidar, scan.pose, scan.sweep)
        map_ms = 1e3 * (time.perf_counter() - began) + self._decode_ms.pop(scan.stamp_ns, 0.0)
        if len(self._decode_ms) > 2 * self.config.pose.queue:
            self._decode_ms.clear()  # those of dropped scans
        self.history.scan(scan)
        self.points_dropped.update(scan.lost(report.dropped))
        if misplaced(report) and not self._missed_why:
            self._missed_at = report.centre
            self._missed_why = likely_reason(scan.points_lidar, scan.pose, self.config)
        overruled = overruled_text(report)
        if overruled is not None:
            self._tell(MAP_OVERRULED, overruled)
        self.refused_divisions += report.refused_divisions
        self.noise_ratio = report.noise_ratio
        if len(self.timings) % LEAST == 0:
            self._judge_poses(mapper)
        counts = report.points, report.points_used, report.leaves, report.divisions
        self.timings.append(ScanTiming(report.stamp_ns, *counts, map_ms))

    def _judge_poses(self, mapper: Mapper) -> None:
        notices = pose_notices(mapper.pose_errors(), self.config)
        self._pose_texts.update({notice.reason: notice.text for notice in notices})

    @property
    def losses(self) -> list[str]:
        """Messages of maps and of what is asked of landing that could not be decoded, a line each.

        `Stream` tells of the others.
        """
        keys = [key for key in self._notices if key.endswith("_encoding")]
        others = [key for key in keys if not key.startswith(("cloud", "pose", "gimbal"))]
        return [one_line(f"{self._notices[k]} messages lost: {self._texts[k]}") for k in others]

    def _note(self) -> None:
        for notice in (*self.intake.notices(), *self.landing.notices):
            self._tell(notice.reason, notice.text)
        self.landing.notices.clear()

    def _tell(self, reason: str, text: str) -> None:
        self._notices[reason] += 1
        self._texts.setdefault(reason, text)
