# SPDX-License-Identifier: Apache-2.0
"""What one scan costs: by stage, by flight, by points, by leaves, and memory of a cell.

Everything is on (exceptions, roughness, subscale features), from the first scan. Times are CPU
times of one core. The stages are timed in a pass of their own, since timing costs time too.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import Recording, configuration, machine, recording, table

from quadtree_lss.config.settings import Config
from quadtree_lss.core.geometry import planes
from quadtree_lss.core.mapping import division, fitting, statistics
from quadtree_lss.core.mapping.features import FeatureEstimator
from quadtree_lss.core.mapping.few_points import FewPoints
from quadtree_lss.core.mapping.mapper import Mapper
from quadtree_lss.core.mapping.mapper import mapper as mapping
from quadtree_lss.core.mapping.update import ScanUpdate
from quadtree_lss.core.sensing.lidar import Pose
from quadtree_lss.core.tree.leaves import Leaves

#: Stage, and the functions whose time is its; time inside another stage's function is that one's.
STAGES: tuple[tuple[str, object, str], ...] = (
    ("validate, to map frame", mapping, "register"),
    ("bin", ScanUpdate, "_round"),
    ("moments", planes, "moments"),
    ("fit", fitting, "fittable"),
    ("fit", fitting, "fit_scan"),
    ("fit", fitting, "fit_scans"),
    ("stored points", FewPoints, "fit"),
    ("fuse", ScanUpdate, "_take"),
    ("fuse", FewPoints, "nudge"),
    ("division statistic", ScanUpdate, "_judge"),
    ("division statistic", division, "asks"),
    ("divide", Leaves, "divide"),
    ("residuals", statistics.FinalGroups, "residuals"),
    ("roughness, exceptions", statistics, "accumulate"),
    ("noise check", statistics.NoiseCheck, "add"),
    ("subscale features", FeatureEstimator, "update"),
    ("rest", Mapper, "update"),
)
FLIGHTS = (("morpheus", "Morpheus, leaves to 0.25 m"), ("parabola", "Section VI, to 1.875 m"))
POINTS = (64, 128, 256, 512, 1024)
LEVELS = (3, 4, 5, 6, 7, 8)


class Stopwatch:
    """Time spent in each stage, without that spent in a stage called from it."""

    def __init__(self) -> None:
        self.spent: Counter[str] = Counter()
        self._open: list[tuple[str, float]] = []

    def timed(self, stage: str, function: Callable) -> Callable:
        """``function``, counted under ``stage``."""

        def wrapper(*args: object, **kwargs: object) -> object:
            now = time.process_time()
            if self._open:
                outer, since = self._open[-1]
                self.spent[outer] += now - since
            self._open.append((stage, time.process_time()))
            try:
                return function(*args, **kwargs)
            finally:
                now = time.process_time()
                _, since = self._open.pop()
                self.spent[stage] += now - since
                if self._open:
                    self._open[-1] = (self._open[-1][0], time.process_time())

        return wrapper

    @contextlib.contextmanager
    def watching(self) -> Iterator[None]:
        """Put wrappers around the functions of all stages, and take them away again."""
        originals = [(owner, name, vars(owner)[name]) for _, owner, name in STAGES]
        try:
            for (stage, owner, name), (_, _, original) in zip(STAGES, originals, strict=True):
                setattr(owner, name, self.timed(stage, original))
            yield
        finally:
            for owner, name, original in originals:
                setattr(owner, name, original)


def cpu_ms(function: Callable[..., object], *args: object) -> float:
    """CPU time of one call, ms."""
    began = time.process_time()
    function(*args)
    return 1e3 * (time.process_time() - began)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=101)
    parser.add_argument("--duration", type=float, help="s of each flight, by default all")
    parser.add_argument("--largest", type=int, default=POINTS[-1], help="side of the largest scan")
    options = parser.parse_args()
    print(machine())
    flights = {name: recording(name, options.seed, options.duration) for name, _ in FLIGHTS}
    totals(flights)
    stages(flights)
    growth_with_points([side for side in POINTS if side <= options.largest])
    growth_with_leaves()
    memory(flights["morpheus"])


def fly(flight: Recording, config: Config) -> tuple[Mapper, np.ndarray]:
    """Map a flight; the time of each scan, ms."""
    mapper = Mapper(config)
    spent = [cpu_ms(mapper.update, *scan[1:]) for scan in flight.scans]
    return mapper, np.array(spent)


def totals(flights: dict[str, Recording]) -> None:
    """Median, 99 % and worst over whole flights."""
    rows = []
    for scenario, name in FLIGHTS:
        mapper, ms = fly(flights[scenario], configuration(scenario))
        median, most = np.percentile(ms, [50.0, 99.0])
        rows.append(
            [
                name,
                len(ms),
                mapper.leaves.count,
                *(f"{value:.2f}" for value in (ms[0], median, most, ms.max(), ms.mean())),
            ]
        )
    table(
        "One scan of 128 x 128 points, everything on, ms (must: median 8, 99 % 25)",
        ["flight", "scans", "leaves", "first", "median", "99 %", "worst", "mean"],
        rows,
    )


def stages(flights: dict[str, Recording]) -> None:
    """Where the time goes."""
    columns = []
    for scenario, _ in FLIGHTS:
        watch = Stopwatch()
        with watch.watching():
            fly(flights[scenario], configuration(scenario))
        columns.append({k: 1e3 * v / len(flights[scenario].scans) for k, v in watch.spent.items()})
    names = list(dict.fromkeys(stage for stage, _, _ in STAGES))
    rows = [[name, *(f"{column.get(name, 0.0):.3f}" for column in columns)] for name in names]
    rows.append(["all", *(f"{sum(column.values()):.3f}" for column in columns)])
    table("Mean of a scan by stage, ms", ["stage", *(name for _, name in FLIGHTS)], rows)


def waves(side: int, stamp: int, rng: np.random.Generator, extent: float = 60.0):
    """An organised scan, ``side`` squared points, of gentle waves seen from 450 m straight up."""
    step = (np.arange(side) + 0.5) / side * extent - 0.5 * extent
    x, y = np.meshgrid(step, step)
    z = 0.1 * np.sin(0.7 * x) * np.sin(0.5 * y)
    seen = np.stack([x, -y, 450.0 - z], axis=-1)
    distance = np.linalg.norm(seen, axis=-1, keepdims=True)
    seen *= 1.0 + 0.06 * rng.standard_normal(distance.shape) / distance
    sigma = np.diag([1e-3] * 3 + [1e-8] * 3)
    return seen, Pose(stamp, np.array([0.0, 0.0, 450.0]), np.diag([1.0, -1.0, -1.0]), sigma)


def growth_with_points(sides: list[int]) -> None:
    """First and later scans of more and more points."""
    rng = np.random.default_rng(1)
    rows = []
    for side in sides:
        scans = [waves(side, k, rng) for k in range(4)]
        mapper = Mapper(configuration("morpheus"))
        ms = [cpu_ms(mapper.update, *scan) for scan in scans]
        points, pose = waves(side, 9, rng)
        loose = cpu_ms(mapper.update, points.reshape(-1, 3), pose)
        later = float(np.median(ms[1:]))
        rows.append(
            [
                f"{side * side:,}",
                mapper.leaves.count,
                f"{ms[0]:.1f}",
                f"{later:.1f}",
                f"{1e3 * later / side**2:.2f}",
                f"{loose:.1f}",
            ]
        )
    table(
        "Growth with points: 64 x 64 m, leaves of 4 to 0.25 m (must: a million in 400 ms)",
        ["points", "leaves", "first ms", "later ms", "us a point", "not organised ms"],
        rows,
    )


def growth_with_leaves() -> None:
    """Fixed resolutions under the same scan."""
    rng = np.random.default_rng(2)
    scans = [waves(128, k, rng, 63.9) for k in range(6)]
    rows = []
    for level in LEVELS:
        config = configuration("morpheus", domain__min_level=level, domain__max_level=level)
        mapper = Mapper(config)
        ms = [cpu_ms(mapper.update, *scan) for scan in scans]
        rows.append(
            [
                f"{4**level:,}",
                f"{64.0 / 2**level:g}",
                f"{ms[0]:.2f}",
                f"{np.median(ms[1:]):.2f}",
                f"{1e3 * np.median(ms[1:]) / 4**level:.2f}",
            ]
        )
    table(
        "Growth with leaves: 16,384 points over leaves of one size",
        ["leaves", "size m", "first ms", "later ms", "us a leaf"],
        rows,
    )


def memory(flight: Recording) -> None:
    """Bytes of a leaf in the mapper's columns and in the message."""
    from quadtree_lss.messages.maps import encode_cells

    mapper, _ = fly(flight, configuration("morpheus"))
    leaves = mapper.leaves
    columns = [
        value
        for value in vars(leaves).values()
        if isinstance(value, np.ndarray) and len(value) == leaves.capacity
    ]
    total = sum(column.nbytes for column in columns)
    records = encode_cells(mapper.snapshot())
    rows = [
        ["leaves", f"{leaves.count:,}", ""],
        ["columns of the mapper, a leaf", f"{total / leaves.capacity:.0f}", "B"],
        ["  allocated for all", f"{total / 2**20:.1f}", "MiB"],
        [
            "index and mask of finest cells, a cell",
            f"{leaves.leaf_of_finest.itemsize + mapper.observed.itemsize}",
            "B",
        ],
        ["map/cells, a leaf", f"{records.dtype.itemsize}", "B"],
        ["  message", f"{records.nbytes / 2**20:.2f}", "MiB"],
    ]
    table("Memory, Morpheus", ["", "", "unit"], rows)


if __name__ == "__main__":
    main()
