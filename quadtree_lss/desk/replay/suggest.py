# SPDX-License-Identifier: Apache-2.0
"""A configuration from the data: where the ground lies, the noise of ranges, the finest cells."""

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
from quadtree_lss.onboard.config.risk import model_warning
from quadtree_lss.onboard.config.settings import (
    DEFAULTS,
    MIN_FOLLOW_LEVEL,
    Config,
    config_from_values,
    values_from_config,
)
from quadtree_lss.onboard.messages.intake import ReadyScan

#: Number of scans of a bag, and of points of each, that are used.
SCANS, POINTS = 60, 1500
#: Neighbours of a return, itself among them, through which a plane is fitted.
NEIGHBOURS = 9
#: Least side of the finest cell, in distances of returns (a plane takes three of one scan) and in
#: range noises; most and least number of finest cells in the vehicle's diameter.
SPACINGS, NOISES, MOST_CELLS, LEAST_CELLS = 1.75, 4.0, 16.0, 6.5
#: Share of the ground that a scan sees, the densest, in which returns are no farther apart.
DENSEST = 0.3
#: Finest cells may be so much larger than wanted, so that the domain fits the data.
SLACK = 1.4
#: Quantile of the variance about a plane and that of chi square of six degrees over six: smooth
#: ground decides.
QUANTILE, AT_QUANTILE = 0.3, 0.638
#: Planes that are steeper are facades and trees; with fewer others, as a share, all count.
STEEPEST_DEG, LEAST_LEVEL = 30.0, 0.1
#: Ranges that are the same, relative; so many at the greatest are no returns, as a share.
SAME, MANY = 1e-5, 0.02
#: Levels between the coarsest and the finest cells.
LEVELS = 4


@dataclass(frozen=True)
class Suggestion:
    """Values for a bag, and why. ``values``: by dotted key. ``reasons``: a line for each key that
    has one. ``notes``: what to know, a line each."""

    values: dict[str, Any]
    reasons: dict[str, str]
    notes: tuple[str, ...]

    def text(self) -> str:
        """A parameter file."""
        lines = [f"# {note}" for note in self.notes]
        return "\n".join([*lines, dump_values(self.values, self.reasons)])

    def as_dict(self) -> dict[str, Any]:
        """In JSON's types."""
        return {"values": self.values, "reasons": self.reasons, "notes": list(self.notes)}


def suggest_config(
    bag: str | Path | Bag,
    config: Config = DEFAULTS,
    *,
    scan_topic: str | None = None,
    pose_topic: str | None = None,
    progress: Progress | None = None,
) -> Suggestion:
    """Domain, range noise, cells and landing grid for a bag, the frame of its map and the mount
    that its transforms give; the arguments are those of `replay.replay`, and what is suggested is
    checked together with ``config``, whose vehicle it suits. Raises `BagError` as that does, and
    `ReplayError`: no scan has a pose, or none a return.
    """
    seen = Seen(config)
    with open_bag(bag) as opened:
        stream = Stream(opened, config, scan_topic, pose_topic, adapt=True)
        count = next(t.count for t in opened.topics if t.name == stream.scans)
        for scan in stream.ready(Part.of(opened), progress):
            seen.add(scan, max(count // SCANS, 1))
        stream.intake.finish()
        causes = [notice.text for notice in stream.intake.notices()]
        if not seen.places:
            why = causes[0] if causes else "no scan has a pose and a return"
            raise ReplayError(
                f"{bag}: nothing to suggest from: {why};"
                f" quadtree-lss doctor {shlex.quote(str(bag))} looks for why"
            )
        return seen.suggestion(Path(opened.path), stream.settings, stream.notes)


class Seen:
    """What scans show. ``config``: of which the lidar's range and the vehicle matter."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self.places: list[Array] = []
        self._scans = 0
        self._noise: list[float] = []
        self._spacing: list[float] = []
        self._most: list[float] = []

    def add(self, scan: ReadyScan, every: int) -> None:
        """Takes a scan; one of ``every`` so many is looked at."""
        lidar = self._config.lidar
        self._scans += 1
        if (self._scans - 1) % every:
            return
        points = scan.points_lidar.reshape(-1, 3).astype(np.float64)
        ranges = np.linalg.norm(points, axis=1)
        with np.errstate(invalid="ignore"):
            sound = (ranges >= lidar.min_range) & (ranges <= lidar.max_range)
        points, ranges = points[sound], ranges[sound]
        at_most = ranges > (1.0 - SAME) * ranges.max(initial=0.0)
        if MANY * len(ranges) < np.count_nonzero(at_most) < (1.0 - MANY) * len(ranges):
            self._most.append(float(ranges.max()))
            points, ranges = points[~at_most], ranges[~at_most]
        if len(points) < NEIGHBOURS:
            return
        placed = points @ scan.pose.rotation_map_lidar.T + scan.pose.position
        few = slice(None, None, max(len(points) // POINTS, 1))
        self.places.append(placed[few])
        third = cKDTree(placed[:, :2]).query(placed[few, :2], k=[4])[0][:, 0]
        area = np.sort(math.pi / 3.0 * third**2)  # of ground for each return
        within = np.searchsorted(np.cumsum(area), DENSEST * area.sum())
        self._spacing.append(math.sqrt(area[int(within)]))
        rays = points / ranges[:, None]
        near = np.asarray(cKDTree(rays).query(rays[few], k=NEIGHBOURS)[1])
        variance, level = _scatter(rays, ranges, few, near), _are_level(placed[near])
        variance = variance[level] if level.mean() > LEAST_LEVEL else variance
        self._noise.append(math.sqrt(float(np.quantile(variance, QUANTILE)) / AT_QUANTILE))

    def suggestion(
        self, bag: Path, settings: Mapping[str, Any], notes: Sequence[str]
    ) -> Suggestion:
        """Values for the scans of a bag, with the ``settings`` and ``notes`` of its stream. Raises
        `ReplayError`: all returns are of one place."""
        config = config_from_values(settings, self._config)
        noise = max(float(f"{np.quantile(self._noise, QUANTILE):.2g}"), 1e-3)  # without dust
        spacing = float(np.median(self._spacing))
        low, high = np.percentile(np.concatenate(self.places)[:, :2], [0.5, 99.5], axis=0)
        middle, side = 0.5 * (low + high), 1.04 * float(np.max(high - low))
        if side == 0.0:
            raise ReplayError(f"{bag}: nothing to suggest from: all returns are of one place")
        vehicle, by_data = config.vehicle, max(SPACINGS * spacing, NOISES * noise)
        least, most = vehicle.diameter / MOST_CELLS, vehicle.diameter / LEAST_CELLS
        wanted = min(max(by_data, least), most)
        lowest = 0 if config.domain.follow == "none" else MIN_FOLLOW_LEVEL
        level = math.ceil(math.log2(side / min(SLACK * wanted, most)))
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
        coarse = size / 2**domain.min_level
        x, y = (f"{a:.1f} ... {b:.1f}" for a, b in zip(low, high, strict=True))
        apart = f"returns of a scan are {spacing:.2g} m apart on the ground, and the vehicle"
        sizes = f"cells of {coarse:g} ... {finest:g} m: {apart} measures {vehicle.diameter:g} m"
        values |= settings
        if 2 * len(self._most) > len(self.places):
            values["lidar.max_range"] = float(f"{0.99 * min(self._most):.3g}")
        reasons = {
            "frames.map": "of the poses",
            "lidar.max_range": "many returns are at one greatest range: rays without a return",
            "mount.source": "/tf_static leads from the poses' frame to the scans'",
            "domain.xmin": f"99 % of the returns lie in x {x}, y {y} m",
            "domain.max_level": sizes,
            "lidar.range_noise": "scatter of neighbouring returns on the smoothest level ground",
        }
        usual = values_from_config(Config())
        given = {
            name: value
            for name, value in values_from_config(config).items()
            if name.startswith("vehicle.") or value != usual[name]
        }
        values = {"lidar.range_noise": noise} | given | values
        found = config_from_values(values, config)
        notes = [f"Suggested for {bag} from {len(self.places)} of its {self._scans} scans.", *notes]
        if by_data > most:
            notes.append(
                f"The returns of a scan are too coarse for a vehicle of {vehicle.diameter:g} m, or"
                f" too noisy: they support cells of {by_data:.2g} m, but the vehicle needs"
                f" {most:.2g} m. Gaps wider than {config.lss.gap:.2g} m (lss.max_gap) stay"
                f" unobserved."
            )
        notes += filter(None, [model_warning(found)])
        return Suggestion(values, reasons, tuple(notes))


def _are_level(placed: Array) -> NDArray[np.bool_]:
    """Whether the planes through groups of points (N, K, 3) in the map are about level."""
    placed = placed - placed.mean(axis=1, keepdims=True)
    axes = np.linalg.eigh(np.einsum("nki,nkj->nij", placed, placed))[1]
    return np.asarray(np.abs(axes[:, 2, 0]) > math.cos(math.radians(STEEPEST_DEG)))


def _scatter(rays: Array, ranges: Array, chosen: slice, near: NDArray[np.intp]) -> Array:
    """Variance of ranges about planes through the chosen returns and their neighbours, m^2.
    ``rays``: (N, 3) unit vectors. ``ranges``: (N,) m. ``near``: (M, K) neighbours of the chosen."""
    middle = rays[chosen]
    first = np.cross(middle, np.where(np.abs(middle[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(middle, first)
    x, y = (np.einsum("kni,ki->kn", rays[near], axis) for axis in (first, second))
    return variance_about_planes(x, y, ranges[near])


def variance_about_planes(x: Array, y: Array, values: Array) -> Array:
    """Variance (N,) of groups of values about a + b x + c y; all are (N, K)."""
    design = np.stack([np.ones_like(x), x, y], axis=-1)
    scale = np.abs(design).max(axis=1, keepdims=True)
    orthogonal, _ = np.linalg.qr(design / np.where(scale > 0.0, scale, 1.0))
    values = values - values.mean(axis=1, keepdims=True)
    fitted = np.einsum("knj,kj->kn", orthogonal, np.einsum("knj,kn->kj", orthogonal, values))
    return np.asarray(np.sum((values - fitted) ** 2, axis=1) / (values.shape[1] - 3))
