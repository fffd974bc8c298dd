# SPDX-License-Identifier: Apache-2.0
"""A bag mapped scan by scan, for who wants to look on."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from quadtree_lss.config.settings import Config
from quadtree_lss.core.mapping.mapper import Mapper, ScanReport
from quadtree_lss.messages.intake import ReadyScan
from quadtree_lss.replay.stream import scans


class Step(NamedTuple):
    """One scan, what became of it, and the mapper that has it now."""

    scan: ReadyScan
    report: ScanReport
    mapper: Mapper


def steps(
    bag: str | Path,
    config: Config,
    *,
    scan_topic: str | None = None,
    pose_topic: str | None = None,
    start: float = 0.0,
    duration: float | None = None,
) -> Iterator[Step]:
    """Maps a bag scan by scan; ``step.mapper.snapshot()`` is the map so far.

    Arguments and errors are those of `scans`.
    """
    mapper = Mapper(config)
    options = {"scan_topic": scan_topic, "pose_topic": pose_topic}
    for scan in scans(bag, config, **options, start=start, duration=duration):
        yield Step(scan, mapper.update(scan.points_lidar, scan.pose, scan.sweep), mapper)
