# SPDX-License-Identifier: Apache-2.0
"""Replay of a bag with the code of the nodes, run synchronously."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace as changed
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import ArrayLike

from quadtree_lss.desk.bags.bag import Bag, open_bag
from quadtree_lss.desk.replay.assessments import Assessments
from quadtree_lss.desk.replay.files import ReplayError, locked, made
from quadtree_lss.desk.replay.history import History
from quadtree_lss.desk.replay.results import ReplayResult, points_line, run_summary, write_results
from quadtree_lss.desk.replay.run import Run
from quadtree_lss.desk.replay.stream import LandingTopics, MapPairs, Part, Progress, Stream
from quadtree_lss.onboard.config.settings import DEFAULTS, Config
from quadtree_lss.onboard.core.mapping.mapper import Mapper, ScanReport
from quadtree_lss.onboard.messages.intake import ReadyScan
from quadtree_lss.onboard.messages.landing_inputs import LandingRequests


def replay(
    bag: str | Path | Bag,
    out: str | Path | None = None,
    config: Config = DEFAULTS,
    *,
    scan_topic: str | None = None,
    pose_topic: str | None = None,
    start: float = 0.0,
    duration: float | None = None,
    report: bool = True,
    record: str | Path | None = None,
    landing: Mapping[str, ArrayLike | None] | None = None,
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
) -> ReplayResult:
    """Map a bag, rank landing sites and write the results.

    The result is deterministic: times of reception replace the clock. If a bag has maps but no
    scans, its last map is used.

    Args:
        bag: Path of a bag, or a `MessageBag`.
        out: Folder for the results; None writes nothing.
        config: The configuration.
        scan_topic, pose_topic: Topics; by default found by name, then by type.
        start, duration: Part of the bag, s (`stream.Part.of`).
        report: Also write figures and ``report.html``.
        record: New bag for the messages that the nodes would publish.
        landing: ``area``, ``keep_out`` (V, 2), ``keep_outs`` (a list of these) and ``target`` (2,),
            map frame, m, or None for none. They replace the bag's topics ``landing/…``.
        progress: See `stream.Progress`.
        stop: Called after each message; True ends the replay.

    Raises:
        BagError: the bag cannot be read or its topics are ambiguous.
        ReplayError: no scan could be mapped, or ``out`` or ``record`` cannot be written.
        KeyboardInterrupt: stopped before the first map.
    """
    folder = None if out is None else Path(out)
    began = time.perf_counter()
    with ExitStack() as stack:
        opened = stack.enter_context(open_bag(bag))
        part = Part.of(opened, start, duration)
        requests = LandingRequests(config.frames.map, landing)
        maps = MapPairs.of_maps_only(opened, scan_topic)
        source = maps or Stream(opened, config, scan_topic, pose_topic)
        topics = LandingTopics(requests, opened, part.start_ns)
        if folder is not None:
            stack.enter_context(made(folder, ReplayError))
            stack.enter_context(locked(folder, ReplayError))
        history = History()
        assessments = Assessments(config, requests.arguments)
        assessments.on_assessment.append(history.landing)
        run = Run(opened, part, config, assessments, topics, history, progress, stop)
        if record is not None:
            from quadtree_lss.desk.replay.record import Recorder  # slow import

            recorder = Recorder(Path(record), config.frames.map, maps=maps is None)
            stack.enter_context(recorder)
            assessments.on_map.append(recorder.map)
            assessments.on_assessment.append(recorder.landing)
        if isinstance(source, MapPairs):
            cells = run.read_maps(source)
        else:
            cells = run.map_scans(source)
        assessments.finish(run.done_ns, lambda: cells)
        losses, counts, notes = [*opened.losses, *run.losses], run.counts(), [*opened.notes]
        if isinstance(source, Stream):
            losses, counts = [*losses, *source.losses], counts | source.counts()
            notes += source.notes
    if progress is not None and not run.interrupted:
        progress(part.seconds, part.seconds)
    decoded, assessment = assessments.cells, assessments.last
    assert decoded is not None and assessment is not None
    if not decoded.observed.any():
        why = points_line(run.points, run.points_dropped)
        why = "the last map has no measurement" if run.maps else why
        assessment = changed(assessment, explanation=f"nothing is mapped: {why}")
    seconds = part.seconds
    if run.interrupted:
        seconds = min(seconds, max(run.done_ns - part.start_ns, 0) / 1e9)
    summary = run_summary(
        decoded,
        assessment,
        config,
        assessments.lss_ms,
        run.timings,
        **counts,
        bag=str(opened.path.resolve()),
        duration=seconds,
        real_time_factor=seconds / (time.perf_counter() - began),
        landing=requests.as_lists(),
        target=assessments.changes[-1].id if assessments.changes else 0,
        target_changes=len(assessments.changes),
        losses=losses,
        warnings=[*assessment.warnings, *notes, *run.warnings()],
    )
    timings, targets = tuple(run.timings), tuple(assessments.changes)
    result = ReplayResult(folder, decoded, assessment, timings, summary, targets)
    if folder is not None:
        write_results(folder, result, config, report, history)
    return result


def scans(
    bag: str | Path | Bag,
    config: Config = DEFAULTS,
    *,
    scan_topic: str | None = None,
    pose_topic: str | None = None,
    start: float = 0.0,
    duration: float | None = None,
) -> Iterator[ReadyScan]:
    """Yield the scans of a bag, each with the lidar's pose at its stamp, as the nodes would map
    them. Arguments and errors as of `replay`."""
    with open_bag(bag) as opened:
        part = Part.of(opened, start, duration)
        stream = Stream(opened, config, scan_topic, pose_topic)
        for scan in stream.ready(part):
            yield scan
            stream.intake.notices()


class Step(NamedTuple):
    """One scan, the report on it, and the mapper after it."""

    scan: ReadyScan
    report: ScanReport
    mapper: Mapper


def steps(bag: str | Path | Bag, config: Config = DEFAULTS, **options: Any) -> Iterator[Step]:
    """Map a bag scan by scan; ``step.mapper.snapshot()`` is the current map. Arguments and errors
    as of `scans`."""
    mapper = Mapper(config)
    for scan in scans(bag, config, **options):
        yield Step(scan, mapper.update(scan.points_lidar, scan.pose, scan.sweep), mapper)
