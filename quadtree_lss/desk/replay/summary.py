# SPDX-License-Identifier: Apache-2.0
"""Key figures of a run for ``summary.json``."""

from __future__ import annotations

import platform
import resource
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

import quadtree_lss
from quadtree_lss import build
from quadtree_lss.desk.replay.results import ScanTiming
from quadtree_lss.onboard.config.settings import Config, values_from_config


def run_summary(
    timings: Sequence[ScanTiming],
    leaves: int,
    config: Config,
    real_time_factor: float,
    lss_ms: float,
) -> dict[str, Any]:
    """Scans, points, leaves, times in ms, memory, versions and configuration of a run.

    Without a scan, as for a bag of maps, the times of a map update are NaN.
    """
    map_ms = np.array([row.map_ms for row in timings] or [np.nan])
    return {
        "scans": len(timings),
        "points": sum(row.points for row in timings),
        "leaves": leaves,
        "map_ms_median": float(np.median(map_ms)),
        "map_ms_p99": float(np.percentile(map_ms, 99)),
        "lss_ms": lss_ms,
        "real_time_factor": real_time_factor,
        "peak_memory_mb": peak_memory_mb(),
        "versions": versions(),
        "config": values_from_config(config),
    }


def peak_memory_mb() -> float:
    """Largest resident size of this process so far, MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e6 / 1024.0)


def versions() -> dict[str, str]:
    """Versions of this package and of what its numbers depend on."""
    found = {"quadtree_lss": quadtree_lss.__version__, "build": build.name()}
    found["python"] = platform.python_version()
    for name in ("numpy", "scipy", "rosbags"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found
