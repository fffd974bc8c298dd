# SPDX-License-Identifier: Apache-2.0
"""A recorded bag through the nodes' logic, synchronously: same messages in, same map out."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from quadtree_lss.configuration import dump_config
from quadtree_lss.core.config import Config
from quadtree_lss.core.mapping import Mapper
from quadtree_lss.core.quadtree import CellMap
from quadtree_lss.core.sites import LandingAssessment, LandingSiteSelector
from quadtree_lss.errors import QuadtreeLssError
from quadtree_lss.messages.clouds import MessageError
from quadtree_lss.messages.intake import Intake, ReadyScan, noise_notice
from quadtree_lss.messages.maps import decode_cells, encode_cells
from quadtree_lss.replay import results
from quadtree_lss.replay.bags import (
    POSE_TOPIC,
    SCAN_TOPIC,
    Bag,
    choose_topic,
)
from quadtree_lss.replay.rescue import RawMessage
from quadtree_lss.replay.results import ScanTiming
from quadtree_lss.replay.summary import run_summary
from quadtree_lss.replay.types import POSE_TYPE, SCAN_TYPE

SECOND_NS = 1_000_000_000

Progress = Callable[[float, float], None]
"""Called with the seconds of the bag that are done and the seconds there are."""


class ReplayError(QuadtreeLssError):
    """The bag gave no map, or the results cannot be written."""


@dataclass(frozen=True)
class ReplayResult:
    """What a replay produced.

    Attributes:
        out: Results folder.
        cells: The map, as decoded from its message.
        assessment: Landing sites on it.
        timings: One row per mapped scan.
        summary: Content of ``summary.json``.
        losses: What could not be read of the bag, one line each; empty if all was read.
        warnings: One line per kind of trouble with the messages, with how often it occurred.
    """

    out: Path
    cells: CellMap
    assessment: LandingAssessment
    timings: tuple[ScanTiming, ...]
    summary: dict[str, Any]
    losses: tuple[str, ...]
    warnings: tuple[str, ...]


def replay(
    bag: str | Path,
    out: str | Path,
    config: Config,
    *,
    scan_topic: str | None = None,
    pose_topic: str | None = None,
    start: float = 0.0,
    duration: float | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> ReplayResult:
    """Maps a bag, ranks landing sites and writes the results.

    Deterministic: messages go in the order of the bag, and their times of reception stand for
    the clock by which scans wait for their pose.

    Args:
        bag: A bag as of `bags.Bag`.
        out: Folder for the results; made if missing.
        config: Everything that can be set.
        scan_topic, pose_topic: Topics; by default found by name, then by type.
        start: Seconds after the bag's first message at which to begin.
        duration: Seconds to process, None for all.
        report: Also draw figures and ``report.html``.
        progress: See `Progress`.

    Raises:
        BagError: the bag cannot be read or its topics are ambiguous.
        ReplayError: no scan could be mapped, or ``out`` cannot be written.
    """
    folder = Path(out)
    began = time.perf_counter()
    run, stream = _Run(config), _Stream(scan_topic, pose_topic, start, duration)
    with Bag(bag) as opened:
        stream.resolve(opened)
        _make_folder(folder)
        run.process(opened, stream, progress)
        losses = tuple(opened.losses)
    cells, assessment, lss_ms = assess(run.mapper.snapshot(), config)
    wall = time.perf_counter() - began
    warnings = tuple(run.warnings())
    summary = {
        **run_summary(run.timings, config, stream.seconds / wall, lss_ms),
        "scans_dropped": dict(run.intake.dropped),
        "points_dropped": dict(run.points_dropped),
        "bag": stream.bag,
        "scan_topic": stream.scans,
        "pose_topic": stream.poses,
        "duration": stream.seconds,
        "poses": run.intake.poses_taken,
        "messages_rejected": dict(run.intake.rejected),
        "range_noise_ratio": run.noise_ratio,
        "refused_divisions": run.refused_divisions,
        "explanation": assessment.explanation,
        "losses": losses,
        "warnings": warnings,
    }
    result = ReplayResult(folder, cells, assessment, tuple(run.timings), summary, losses, warnings)
    try:
        _write(result, config, report)
    except OSError as error:
        msg = f"{folder}: cannot be written: {error.strerror}"
        raise ReplayError(msg) from None
    return result


def assess(cells: CellMap, config: Config) -> tuple[CellMap, LandingAssessment, float]:
    """Landing sites on the map as its message gives it to ``lss_node``.

    Returns:
        The decoded map, the assessment, and what the assessment took in ms.
    """
    records = encode_cells(cells)
    domain = cells.domain
    decoded = decode_cells(records, cells.observed, domain.xmin, domain.ymin, cells.stamp_ns)
    began = time.perf_counter()
    assessment = LandingSiteSelector(config).assess(decoded)
    return decoded, assessment, 1e3 * (time.perf_counter() - began)


@dataclass
class _Stream:
    """Which messages of the bag are read."""

    scan_topic: str | None
    pose_topic: str | None
    start: float
    duration: float | None
    start_ns: int = 0
    stop_ns: int = 0
    seconds: float = 0.0
    scans: str = ""
    poses: str = ""
    bag: str = ""

    def resolve(self, bag: Bag) -> None:
        self.bag = bag.path.name
        self.scans = choose_topic(bag, self.scan_topic, SCAN_TOPIC, SCAN_TYPE, "--scan-topic")
        self.poses = choose_topic(bag, self.pose_topic, POSE_TOPIC, POSE_TYPE, "--pose-topic")
        length = (bag.end_ns - bag.start_ns) / SECOND_NS
        if not 0.0 <= self.start <= length:
            msg = f"--start {self.start:g} s is outside the bag's {length:.3f} s"
            raise ReplayError(msg)
        if self.duration is not None and not self.duration > 0.0:
            msg = f"--duration {self.duration:g} s is not positive"
            raise ReplayError(msg)
        self.start_ns = bag.start_ns + round(self.start * SECOND_NS)
        self.stop_ns = bag.end_ns + 1
        if self.duration is not None:
            self.stop_ns = min(self.stop_ns, self.start_ns + round(self.duration * SECOND_NS))
        self.seconds = (min(self.stop_ns, bag.end_ns) - self.start_ns) / SECOND_NS


@dataclass
class _Run:
    """State while messages pass."""

    config: Config
    timings: list[ScanTiming] = field(default_factory=list)
    points_dropped: Counter[str] = field(default_factory=Counter)
    refused_divisions: int = 0
    noise_ratio: float = float("nan")

    def __post_init__(self) -> None:
        self.mapper = Mapper(self.config)
        self.intake = Intake(self.config)
        self._notices: Counter[str] = Counter()
        self._texts: dict[str, str] = {}
        self._decode_ms: dict[int, float] = {}

    def process(self, bag: Bag, stream: _Stream, progress: Progress | None) -> None:
        """Maps every scan of the stream."""
        self.intake = Intake(self.config, scan_topic=stream.scans, pose_topic=stream.poses)
        shown = stream.start_ns
        for message in bag.messages((stream.scans, stream.poses), stream.start_ns, stream.stop_ns):
            self._take(bag, stream, message)
            for scan in self.intake.ready(message.received_ns):
                self._map(scan)
            self._note()
            if progress is not None and message.received_ns - shown >= SECOND_NS // 5:
                shown = message.received_ns
                progress((shown - stream.start_ns) / SECOND_NS, stream.seconds)
        self.intake.finish()
        self._note()
        if progress is not None:
            progress(stream.seconds, stream.seconds)
        if not self.timings:
            causes = "; ".join(self.warnings()) or "there is no scan in this part of the bag"
            msg = f"{bag.path}: no scan could be mapped: {causes}"
            raise ReplayError(msg)

    def warnings(self) -> list[str]:
        """One line per kind of trouble, most frequent first."""
        lines = [f"{n} x {key}: {self._texts[key]}" for key, n in self._notices.most_common()]
        if self.refused_divisions:
            lines.append(f"{self.refused_divisions} divisions refused (mapping.max_cells)")
        noise = noise_notice(self.noise_ratio, self.config)
        if noise is not None:
            lines.append(noise.text)
        return lines

    def _take(self, bag: Bag, stream: _Stream, message: RawMessage) -> None:
        is_scan = message.topic == stream.scans
        try:
            msg = bag.decode(message.raw, SCAN_TYPE if is_scan else POSE_TYPE)
        except MessageError as error:
            self.intake.reject("cloud" if is_scan else "pose", error)
            return
        if not is_scan:
            self.intake.on_pose(msg)
            return
        began = time.perf_counter()
        stamp_ns = self.intake.on_cloud(msg, message.received_ns)
        if stamp_ns is not None:
            self._decode_ms[stamp_ns] = 1e3 * (time.perf_counter() - began)

    def _map(self, scan: ReadyScan) -> None:
        began = time.perf_counter()
        report = self.mapper.update(scan.points_lidar, scan.pose)
        map_ms = 1e3 * (time.perf_counter() - began) + self._decode_ms.pop(scan.stamp_ns, 0.0)
        if len(self._decode_ms) > 2 * self.config.pose.queue:
            self._decode_ms.clear()  # those of dropped scans
        self.points_dropped.update(report.dropped)
        self.refused_divisions += report.refused_divisions
        self.noise_ratio = report.noise_ratio
        self.timings.append(
            ScanTiming(
                report.stamp_ns,
                report.points,
                report.points_used,
                report.leaves,
                report.divisions,
                map_ms,
            )
        )

    def _note(self) -> None:
        for notice in self.intake.notices():
            self._notices[notice.reason] += 1
            self._texts.setdefault(notice.reason, notice.text)


def _make_folder(folder: Path) -> None:
    """Before the work begins: a folder that cannot be written would waste it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        msg = f"{folder}: cannot be written: {error.strerror}"
        raise ReplayError(msg) from None


def _write(result: ReplayResult, config: Config, report: bool) -> None:
    out = result.out
    results.write_sites(out / "sites.csv", result.assessment)
    results.write_cells(out / "cells.npz", result.cells)
    results.write_grid(out / "grid.npz", result.assessment)
    results.write_timing(out / "timing.csv", result.timings)
    results.write_bytes(out / "config.yaml", dump_config(config).encode())
    results.write_summary(out / "summary.json", result.summary)
    results.remove_report(out)
    if report:
        from quadtree_lss.replay.report import write_report  # matplotlib takes long to import

        write_report(result, config)
