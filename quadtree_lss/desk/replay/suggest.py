# SPDX-License-Identifier: Apache-2.0
"""Suggestion of a configuration from a bag: domain, range noise, finest cells."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from quadtree_lss.desk.bags.bag import Bag, open_bag
from quadtree_lss.desk.replay.configuration import dump_values
from quadtree_lss.desk.replay.files import ReplayError
from quadtree_lss.desk.replay.stream import Part, Progress, Stream
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config import settings
from quadtree_lss.onboard.config.risk import model_warning
from quadtree_lss.onboard.config.settings import DEFAULTS, Config
from quadtree_lss.onboard.messages.intake import ReadyScan

MAX_SCANS, MAX_POINTS = 60, 1500
"""Number of scans used of a bag, and of points of each scan."""
NEIGHBOURS = 9
"""Number of returns to which a plane is fitted: one and its nearest neighbours."""
MIN_SPACINGS, MIN_NOISES = 1.75, 4.0
"""Least side of the finest cell, as multiples of the distance of returns (a plane needs three of
one scan) and of the range noise."""
MAX_CELLS, MIN_CELLS = 16.0, 6.5
"""Limits of the number of finest cells along the vehicle's diameter."""
DENSE_SHARE = 0.3
"""The distance of returns is the greatest one in this densest share of the observed ground."""
CELL_SLACK = 1.4
"""Factor by which finest cells may exceed the wanted size, so that the domain fits the data."""
QUANTILE, CHI2_QUANTILE = 0.3, 0.638
"""Quantile of the variances about planes, so that smooth ground is used, and this quantile of chi
square with six degrees of freedom, over six."""
MAX_SLOPE_DEG, MIN_LEVEL_SHARE = 30.0, 0.1
"""Steeper planes are ignored as facades and trees, unless fewer than this share are level."""
EQUAL_RANGES, NO_RETURN_SHARE = 1e-5, 0.02
"""Relative difference of equal ranges; more than this share of equal ranges at the greatest one
are rays without a return."""
LEVELS = 4
"""Number of levels between the coarsest and the finest cells."""


@dataclass(frozen=True)
class Suggestion:
    """Suggested values by dotted key, ``reasons`` for some keys, and ``notes``, one line each."""

    values: dict[str, Any]
    reasons: dict[str, str]
    notes: tuple[str, ...]

    def text(self) -> str:
        lines = [f"# {note}" for note in self.notes]
        return "\n".join([*lines, dump_values(self.values, self.reasons)])

    def as_dict(self) -> dict[str, Any]:
        return {"values": self.values, "reasons": self.reasons, "notes": list(self.notes)}


def suggest_config(
    bag: str | Path | Bag,
    config: Config = DEFAULTS,
    *,
    scan_topic: str | None = None,
    pose_topic: str | None = None,
    progress: Progress | None = None,
) -> Suggestion:
    """Suggest domain, range noise, cells and landing grid for a bag, and map frame and mount from
    its poses and transforms.

    Arguments as of `replay.replay`. The values suit the vehicle of ``config`` and are valid
    together with it. Raises `BagError` as `replay.replay`, and `ReplayError`: no scan has a pose
    and a return.
    """
    statistics = ScanStatistics(config)
    with open_bag(bag) as opened:
        stream = Stream(opened, config, scan_topic, pose_topic, adapt=True)
        count = next(t.count for t in opened.topics if t.name == stream.scans)
        for scan in stream.ready(Part.of(opened), progress):
            statistics.add(scan, max(count // MAX_SCANS, 1))
        stream.intake.finish()
        causes = [notice.text for notice in stream.intake.notices()]
        if not statistics.points:
            why = causes[0] if causes else "no scan has a pose and a return"
            raise ReplayError(
                f"{bag}: nothing to suggest from: {why};"
                f" quadtree-lss doctor {shlex.quote(str(bag))} finds the cause"
            )
        return statistics.suggestion(Path(opened.path), stream.settings, stream.notes)


class ScanStatistics:
    """Noise, spacing and extent of the returns of some scans. ``points``: (N, 3) of each scan, map
    frame, m."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self.points: list[Array] = []
        self._scans = 0
        self._noise: list[float] = []
        self._spacing: list[float] = []
        self._max_ranges: list[float] = []  # of scans with rays without a return

    def add(self, scan: ReadyScan, every: int) -> None:
        """Add a scan; one of ``every`` scans is used."""
        lidar = self._config.lidar
        self._scans += 1
        if (self._scans - 1) % every:
            return
        points = scan.points_lidar.reshape(-1, 3).astype(np.float64)
        ranges = np.linalg.norm(points, axis=1)
        with np.errstate(invalid="ignore"):
            valid = (ranges >= lidar.min_range) & (ranges <= lidar.max_range)
        points, ranges = points[valid], ranges[valid]
        greatest = ranges > (1.0 - EQUAL_RANGES) * ranges.max(initial=0.0)
        least = NO_RETURN_SHARE * len(ranges)
        if least < np.count_nonzero(greatest) < (1.0 - NO_RETURN_SHARE) * len(ranges):
            self._max_ranges.append(float(ranges.max()))
            points, ranges = points[~greatest], ranges[~greatest]
        if len(points) < NEIGHBOURS:
            return
        points_map = points @ scan.pose.rotation_map_lidar.T + scan.pose.position
        few = slice(None, None, max(len(points) // MAX_POINTS, 1))
        self.points.append(points_map[few])
        third = cKDTree(points_map[:, :2]).query(points_map[few, :2], k=[4])[0][:, 0]
        area = np.sort(math.pi / 3.0 * third**2)  # of ground for each return
        within = np.searchsorted(np.cumsum(area), DENSE_SHARE * area.sum())
        self._spacing.append(math.sqrt(area[int(within)]))
        rays = points / ranges[:, None]
        near = np.asarray(cKDTree(rays).query(rays[few], k=NEIGHBOURS)[1])
        variance, level = _scatter(rays, ranges, few, near), _are_level(points_map[near])
        variance = variance[level] if level.mean() > MIN_LEVEL_SHARE else variance
        self._noise.append(math.sqrt(float(np.quantile(variance, QUANTILE)) / CHI2_QUANTILE))

    def suggestion(self, bag: Path, known: Mapping[str, Any], notes: Sequence[str]) -> Suggestion:
        """Suggest values for a bag with the ``known`` values and ``notes`` of its stream. Raises
        `ReplayError`: all returns are at one position."""
        config = settings.config_from_values(known, self._config)
        noise = max(float(f"{np.quantile(self._noise, QUANTILE):.2g}"), 1e-3)  # without dust
        spacing = float(np.median(self._spacing))
        low, high = np.percentile(np.concatenate(self.points)[:, :2], [0.5, 99.5], axis=0)
        middle, side = 0.5 * (low + high), 1.04 * float(np.max(high - low))
        if side == 0.0:
            raise ReplayError(f"{bag}: nothing to suggest from: all returns are at one position")
        vehicle, data_cell = config.vehicle, max(MIN_SPACINGS * spacing, MIN_NOISES * noise)
        min_cell, max_cell = vehicle.diameter / MAX_CELLS, vehicle.diameter / MIN_CELLS
        cell = min(max(data_cell, min_cell), max_cell)
        lowest = 0 if config.domain.follow == "none" else settings.MIN_FOLLOW_LEVEL
        level = math.ceil(math.log2(side / min(CELL_SLACK * cell, max_cell)))
        level = min(max(level, lowest), 10)
        finest = math.ceil(1000.0 * side / 2**level) / 1000.0
        size = finest * 2**level
        corner = np.round(2.0 * (middle - 0.5 * size)) / 2.0
        domain = replace(config.domain, size=size, min_level=max(level - LEVELS, lowest))
        grid = min(finest, 2.0 * vehicle.lengths.grid_spacing)
        grid = round(grid, 3) if not lowest else domain.step / math.ceil(domain.step / grid - 1e-9)
        values: dict[str, Any] = {
            "domain.xmin": float(corner[0]),
            "domain.ymin": float(corner[1]),
            "domain.size": round(size, 6),
            "domain.min_level": domain.min_level,
            "domain.max_level": level,
            "lss.grid_spacing": grid,
        }
        if config.lss.dispersion == DEFAULTS.lss.dispersion:
            scaled = config.lss.dispersion * vehicle.diameter_ratio
            values["lss.dispersion"] = float(f"{scaled:.2g}")
        coarse = size / 2**domain.min_level
        x, y = (f"{a:.1f} ... {b:.1f}" for a, b in zip(low, high, strict=True))
        sizes = f"cells of {coarse:g} ... {finest:g} m: returns of a scan are {spacing:.2g} m apart"
        sizes += f" on the ground, and the vehicle measures {vehicle.diameter:g} m"
        values |= known
        if 2 * len(self._max_ranges) > len(self.points):
            values["lidar.max_range"] = float(f"{0.99 * min(self._max_ranges):.3g}")
        reasons = {
            "frames.map": "frame of the poses",
            "lidar.max_range": "many returns are at one greatest range: rays without a return",
            "mount.source": "/tf_static connects the frames of poses and scans",
            "domain.xmin": f"99 % of the returns lie in x {x}, y {y} m",
            "domain.max_level": sizes,
            "lss.dispersion": "half a diameter: set the touchdown error of your vehicle",
            "lidar.range_noise": "scatter of neighbouring returns on the smoothest level ground",
        }
        defaults = settings.values_from_config(Config())
        changed = {
            name: value
            for name, value in settings.values_from_config(config).items()
            if name.startswith("vehicle.") or value != defaults[name]
        }
        values = {"lidar.range_noise": noise} | changed | values
        suggested = settings.config_from_values(values, config)
        notes = [f"Suggested for {bag} from {len(self.points)} of its {self._scans} scans.", *notes]
        if data_cell > max_cell:
            notes.append(
                f"The returns of a scan are too coarse for a vehicle of {vehicle.diameter:g} m, or"
                f" too noisy: they support cells of {data_cell:.2g} m, but the vehicle needs"
                f" {max_cell:.2g} m. Gaps wider than {config.lss.gap:.2g} m (lss.max_gap) stay"
                f" unobserved."
            )
        notes += filter(None, [model_warning(suggested)])
        return Suggestion(values, reasons, tuple(notes))


def _are_level(points_map: Array) -> NDArray[np.bool_]:
    """Return whether planes through groups of points (N, K, 3) are level, (N,)."""
    centred = points_map - points_map.mean(axis=1, keepdims=True)
    axes = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))[1]
    return np.asarray(np.abs(axes[:, 2, 0]) > math.cos(math.radians(MAX_SLOPE_DEG)))


def _scatter(rays: Array, ranges: Array, chosen: slice, near: NDArray[np.intp]) -> Array:
    """Compute the variance (M,) of ranges about planes through M returns and neighbours, m^2.
    ``rays``: (N, 3) unit vectors. ``ranges``: (N,) m. ``near``: (M, K) neighbours of the chosen."""
    middle = rays[chosen]
    first = np.cross(middle, np.where(np.abs(middle[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(middle, first)
    x, y = (np.einsum("kni,ki->kn", rays[near], axis) for axis in (first, second))
    return variance_about_planes(x, y, ranges[near])


def variance_about_planes(x: Array, y: Array, values: Array) -> Array:
    """Compute the variance (N,) of groups of values about a + b x + c y; arguments are (N, K)."""
    design = np.stack([np.ones_like(x), x, y], axis=-1)
    scale = np.abs(design).max(axis=1, keepdims=True)
    orthogonal, _ = np.linalg.qr(design / np.where(scale > 0.0, scale, 1.0))
    values = values - values.mean(axis=1, keepdims=True)
    fitted = np.einsum("knj,kj->kn", orthogonal, np.einsum("knj,kn->kj", orthogonal, values))
    return np.asarray(np.sum((values - fitted) ** 2, axis=1) / (values.shape[1] - 3))
