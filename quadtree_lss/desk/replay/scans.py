# SPDX-License-Identifier: Apache-2.0
"""Scans of a recording one by one, and the map as it grows."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from quadtree_lss.desk.bags.bag import Bag
from quadtree_lss.desk.bags.cloud_files import open_recording
from quadtree_lss.desk.replay.stream import Stream
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.mapping.mapper import Mapper, ScanReport
from quadtree_lss.onboard.elevation.prior_file import read_prior
from quadtree_lss.onboard.messages.intake import ReadyScan


def scans(
    bag: str | Path | Bag,
    config: Config,
    *,
    scan_topic: str | None = None,
    pose_topic: str | None = None,
    poses: str | Path | None = None,
    start: float = 0.0,
    duration: float | None = None,
) -> Iterator[ReadyScan]:
    """Scans of a bag, each with the lidar's pose at its stamp, as the nodes would map them; the
    arguments are those of `replay.replay`. Raises `BagError` or `ReplayError` as that does."""
    stream = Stream(scan_topic, pose_topic, start, duration)
    given = bag if isinstance(bag, Bag) else open_recording(bag, poses, config.frames.map)
    with given as opened:
        stream.resolve(opened, config)
        intake = stream.intake(config)
        for message in stream.messages(opened):
            stream.take(opened, intake, message)
            yield from intake.ready(message.received_ns)
            intake.notices()


class Step(NamedTuple):
    """One scan, what became of it, and the mapper that has it now."""

    scan: ReadyScan
    report: ScanReport
    mapper: Mapper


def steps(bag: str | Path | Bag, config: Config, **options: Any) -> Iterator[Step]:
    """Maps a bag scan by scan; ``step.mapper.snapshot()`` is the map so far.

    Arguments, options and errors are those of `scans`.
    """
    mapper = Mapper(config, read_prior(config))
    for scan in scans(bag, config, **options):
        yield Step(scan, mapper.update(scan.points_lidar, scan.pose, scan.sweep), mapper)
