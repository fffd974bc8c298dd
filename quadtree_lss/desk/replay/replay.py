# SPDX-License-Identifier: Apache-2.0
"""Replay of a bag with the code of the nodes, run synchronously."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace as changed
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import ArrayLike

from quadtree_lss.desk.bags.bag import Bag, open_bag
from quadtree_lss.desk.bags.recorded_file import RawMessage
from quadtree_lss.desk.replay import results
from quadtree_lss.desk.replay.assessments import Assessments, History
from quadtree_lss.desk.replay.files import ReplayError, locked
from quadtree_lss.desk.replay.results import ReplayResult, ScanTiming
from quadtree_lss.desk.replay.stream import (
    LandingTopics,
    MapPairs,
    Part,
    Progress,
    Selection,
    Stream,
)
from quadtree_lss.onboard.config.settings import DEFAULTS, Config
from quadtree_lss.onboard.core.mapping.mapper import OFFSET_SCANS, Mapper, ScanReport
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.errors import one_line
from quadtree_lss.onboard.messages import lost_points
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.intake import Notice, ReadyScan, noise_notice, pose_notice
from quadtree_lss.onboard.messages.landing_inputs import AREA, LandingRequests


def replay(
    bag: str | Path | Bag,
    out: str | Path | None = None,
    config: Config = DEFAULTS,
    *,
    report: bool = True,
    record: str | Path | None = None,
    landing: Mapping[str, ArrayLike | None] | None = None,
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
    **selection: Any,
) -> ReplayResult:
    """Map a bag, rank landing sites and write the results.

    The result is deterministic: times of reception replace the clock. If a bag has maps but no
    scans, its last map is used.

    Args:
        bag: Path of a bag, or a `MessageBag`.
        out: Folder for the results; None writes nothing.
        config: The configuration.
        report: Also write figures and ``report.html``.
        record: New bag for the messages that the nodes would publish.
        landing: ``area``, ``keep_out`` (V, 2), ``keep_outs`` (a list of these) and ``target`` (2,),
            map frame, m, or None for none. They replace the bag's topics ``landing/…``.
        progress: See `stream.Progress`.
        stop: Called after each message; True ends the replay.
        selection: ``scan_topic``, ``pose_topic``, ``start`` and ``duration``, as in `Selection`.

    Raises:
        BagError: the bag cannot be read or its topics are ambiguous.
        ReplayError: no scan could be mapped, or ``out`` or ``record`` cannot be written.
        KeyboardInterrupt: stopped before the first map.
    """
    folder = None if out is None else Path(out)
    began, chosen = time.perf_counter(), Selection(**selection)
    with ExitStack() as stack:
        opened = stack.enter_context(open_bag(bag))
        part = Part.of(opened, chosen.start, chosen.duration)
        maps = MapPairs.of_maps_only(opened, chosen.scan_topic)
        source = maps or Stream(opened, config, chosen.scan_topic, chosen.pose_topic)
        requests = LandingRequests(config.frames.map, landing)
        topics = LandingTopics(requests, opened, part.start_ns)
        if folder is not None:
            stack.enter_context(locked(folder, ReplayError))
        run = _Run(opened, part, config, topics, progress, stop)
        assessments = run.assessments
        if record is not None:
            from quadtree_lss.desk.replay.record import Recorder  # slow import

            recorder = Recorder(Path(record), config.frames.map, maps=maps is None)
            stack.enter_context(recorder)
            assessments.on_map.append(recorder.map)
            assessments.on_assessment.append(recorder.landing)
        if isinstance(source, MapPairs):
            cells, losses, counts, notes = run.read_maps(source), [], {}, []
        else:
            cells = run.map_scans(source)
            losses, counts, notes = source.losses, source.counts(), source.notes
        decoded, assessment = assessments.finish(run.done_ns, lambda: cells)
    if progress is not None and not run.interrupted:
        progress(part.seconds, part.seconds)
    if not decoded.observed.any():
        why = results.points_line(run.points, run.points_dropped)
        why = "the last map has no measurement" if run.maps else why
        assessment = changed(assessment, explanation=f"nothing is mapped: {why}")
    seconds = part.seconds
    if run.interrupted:
        seconds = min(seconds, max(run.done_ns - part.start_ns, 0) / 1e9)
    summary = results.run_summary(
        decoded,
        assessment,
        config,
        assessments.lss_ms,
        run.timings,
        **counts,
        points_used=run.points - run.points_dropped.total(),
        points_dropped=dict(run.points_dropped),
        maps=run.maps,
        range_noise_ratio=run.noise_ratio,
        refused_divisions=run.refused_divisions,
        interrupted=run.interrupted,
        bag=str(opened.path.resolve()),
        duration=seconds,
        real_time_factor=seconds / (time.perf_counter() - began),
        landing=requests.as_lists(),
        target=assessments.changes[-1].id if assessments.changes else 0,
        target_changes=len(assessments.changes),
        losses=[*opened.losses, *run.losses, *losses],
        warnings=[*assessment.warnings, *opened.notes, *notes, *run.warnings()],
    )
    timings, targets = tuple(run.timings), tuple(assessments.changes)
    result = ReplayResult(folder, decoded, assessment, timings, summary, targets)
    if folder is not None:
        results.write_results(folder, result, config, report, run.history)
    return result


def scans(
    bag: str | Path | Bag, config: Config = DEFAULTS, **selection: Any
) -> Iterator[ReadyScan]:
    """Yield the scans of a bag, each with the lidar's pose at its stamp, as the nodes would map
    them. Arguments and errors as of `replay`."""
    chosen = Selection(**selection)
    with open_bag(bag) as opened:
        stream = Stream(opened, config, chosen.scan_topic, chosen.pose_topic)
        for scan in stream.ready(Part.of(opened, chosen.start, chosen.duration)):
            yield scan
            stream.intake.notices()


class Step(NamedTuple):
    """One scan, the report on it, and the mapper after it."""

    scan: ReadyScan
    report: ScanReport
    mapper: Mapper


def steps(bag: str | Path | Bag, config: Config = DEFAULTS, **selection: Any) -> Iterator[Step]:
    """Map a bag scan by scan; ``step.mapper.snapshot()`` is the current map. Arguments and errors
    as of `scans`."""
    mapper = Mapper(config)
    for scan in scans(bag, config, **selection):
        yield Step(scan, mapper.update(scan.points_lidar, scan.pose, scan.sweep), mapper)


class _Run:
    """Processes a part of an open bag.

    If ``stop`` returns True after a message, the run is ``interrupted``. ``done_ns``: time of
    reception of the last message; ``points_dropped``: points of mapped scans that are not in the
    map, by reason; ``maps``: number of maps read.
    """

    def __init__(
        self,
        bag: Bag,
        part: Part,
        config: Config,
        landing: LandingTopics,
        progress: Progress | None,
        stop: Callable[[], bool] | None,
    ) -> None:
        self._bag, self._part, self._config, self._landing = bag, part, config, landing
        self._progress, self._stop = progress, stop
        self.history = History()
        self.assessments = Assessments(config, landing.requests.arguments)
        self.assessments.on_assessment.append(self.history.landing)
        self.interrupted, self.done_ns, self.maps = False, 0, 0
        self.timings: list[ScanTiming] = []
        self.points_dropped: Counter[str] = Counter()
        self.refused_divisions, self.noise_ratio = 0, float("nan")
        self._notices: Counter[str] = Counter()
        self._texts: dict[str, str] = {}  # of the first notice by reason
        self._pose_text = ""
        self._decode_ms: dict[int, float] = {}
        self._missed_at: tuple[float, float] | None = None

    def map_scans(self, stream: Stream) -> CellMap:
        """Map the scans of a stream; return the last map. Raises `ReplayError`: no scan could be
        mapped; KeyboardInterrupt: stopped before the first one."""
        mapper = Mapper(self._config)
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
                found = pairs.add(self._bag, message, self._config.lss)
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

    def warnings(self) -> list[str]:
        """One line for each kind of problem, most frequent first."""
        lost, domain = self.points_dropped, Domain.of(self._config.domain)
        refused = self.refused_divisions
        noise = noise_notice(self.noise_ratio, self._config)
        lines = [
            results.points_warning(self.points, lost, domain, self._missed_at),
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
        mapper.set_area(self._landing.requests.values[AREA])
        began = time.perf_counter()
        report = mapper.update(scan.points_lidar, scan.pose, scan.sweep)
        map_ms = 1e3 * (time.perf_counter() - began) + self._decode_ms.pop(scan.stamp_ns, 0.0)
        self.history.scan(scan)
        self.points_dropped.update(scan.lost(report.dropped))
        if lost_points.misplaced(report):
            self._missed_at = self._missed_at or report.centre
        if (overruled := lost_points.overruled_text(report)) is not None:
            self._add_notice(lost_points.MAP_OVERRULED, overruled)
        self.refused_divisions += report.refused_divisions
        self.noise_ratio = report.noise_ratio
        if len(self.timings) % OFFSET_SCANS == 0:
            self._check_poses(mapper)
        counts = report.points, report.points_used, report.leaves, report.divisions
        self.timings.append(ScanTiming(report.stamp_ns, *counts, map_ms))

    def _navigate(self, what: str, msg: Any, _: RawMessage) -> None:
        if what == "pose":
            self._landing.requests.navigation.use_pose(msg)

    def _check_poses(self, mapper: Mapper) -> None:
        notice = pose_notice(mapper.unexplained_offset())
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
