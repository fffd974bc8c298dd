# SPDX-License-Identifier: Apache-2.0
"""Time, accuracy and consistency of the map of a flight."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from common.consistency import Counts, prefit_statistics
from common.flights import Recording
from quadtree_lss.desk.replay.results import grid_of
from quadtree_lss.lab.evaluation.metrics import (
    Detection,
    ElevationError,
    detection,
    elevation_error,
    safety_field,
    site_verdicts,
)
from quadtree_lss.lab.evaluation.results import TOP
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.register import register


@dataclass(frozen=True)
class MapScore:
    """Scores of one flight with one configuration; ``scan_ms`` is the CPU time of each update."""

    leaves: int
    elevation: ElevationError
    detection: Detection
    unsafe_in_top_five: int
    scan_ms: np.ndarray
    counts: Counts

    @property
    def seconds(self) -> float:
        """CPU time of all scans."""
        return 1e-3 * self.scan_ms.sum()


def score(flight: Recording, config: Config, *, consistent: bool = True) -> MapScore:
    """Map a flight; compare the map with the truth and each scan with the map before it."""
    mapper, counts, times = Mapper(config), Counts(), []
    for scan in flight.scans:
        if consistent:
            registered, _ = register(*scan[1:3], config.lidar, mapper.domain, scan.sweep)
            counts += prefit_statistics(mapper.snapshot(), registered, config.lidar).counts()
        began = time.process_time()
        mapper.update(scan.points_lidar, scan.pose, scan.sweep)
        times.append(1e3 * (time.process_time() - began))
    cells = mapper.snapshot()
    found = LandingSiteSelector(config).assess(cells)
    grid, truth = grid_of(found), flight.truth
    return MapScore(
        leaves=int(cells.estimated.sum()),
        elevation=elevation_error(cells, grid, truth),
        detection=detection(safety_field(grid, truth)),
        unsafe_in_top_five=site_verdicts(found.sites.position[:TOP], truth).count("unsafe"),
        scan_ms=np.array(times),
        counts=counts,
    )
