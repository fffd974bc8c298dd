# SPDX-License-Identifier: Apache-2.0
"""Comparison of two results of the same ground, without truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.desk.exchange.saved import Grid, Results, ResultsError, load_results
from quadtree_lss.desk.replay.files import plain
from quadtree_lss.desk.replay.results import aligned
from quadtree_lss.desk.report.palette import HAZARDS
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.landing.hazards import UNMAPPED, UNSEEN

SIGMAS = 3.0
SAME_GROUND = 0.5
"""Least correlation of heights of the same ground. Measured: 0.97 for one field, 0.1 for two
fields, 0.71 for mounds shifted by 3 m."""


class Heights(NamedTuple):
    """Second minus first height where both observed the ground, m. ``most``: 95th percentile of the
    magnitude; (``x``, ``y``): position of the ``greatest``; ``beyond``: share of differences, with
    the mean removed, that exceed 3 σ of both maps."""

    points: int
    mean: float
    rms: float
    rms_mean_removed: float
    most: float
    greatest: float
    x: float
    y: float
    beyond: float
    correlation: float


class Site(NamedTuple):
    """A site of only one result; ``elsewhere``: the other result's assessment of its position."""

    rank: int
    x: float
    y: float
    z: float
    elsewhere: str


@dataclass(frozen=True)
class Comparison:
    """The differences between two results of the same ground; the second is the newer one.

    Areas in m²: allowed part of the ground that both observed, in each result (``safe_…``) and in
    only one (``gained``, ``lost``); ground that only one observed (``seen_…``). ``sites_kept``:
    pairs of ranks.
    """

    first: Results
    second: Results
    heights: Heights
    safe_first: float
    safe_second: float
    gained: float
    lost: float
    seen_first: float
    seen_second: float
    sites_kept: tuple[tuple[int, int], ...]
    sites_gained: tuple[Site, ...]
    sites_lost: tuple[Site, ...]

    @property
    def same_ground(self) -> bool:
        """True if heights are correlated, or differ by no more than noise on level ground."""
        noise = max(r.config.lidar.range_noise for r in (self.first, self.second))
        return self.heights.correlation >= SAME_GROUND or self.heights.rms_mean_removed <= noise

    def as_dict(self) -> dict[str, Any]:
        names = ("safe_first", "safe_second", "gained", "lost", "seen_first", "seen_second")
        content = {
            "first": str(self.first.folder),
            "second": str(self.second.folder),
            "same_ground": self.same_ground,
            "heights": self.heights,
            "area": {name: getattr(self, name) for name in names},
            "sites_kept": self.sites_kept,
            "sites_gained": self.sites_gained,
            "sites_lost": self.sites_lost,
        }
        return dict(plain(content))

    def table(self) -> str:
        h = self.heights
        rows = [
            ("Ground observed by both", f"{h.points} grid points"),
            ("  by only one", f"{self.seen_first:.0f} m² / {self.seen_second:.0f} m²"),
            ("Height, second less first, mean", f"{h.mean:+.3f} m"),
            ("  RMS / with the mean removed", f"{h.rms:.3f} / {h.rms_mean_removed:.3f} m"),
            ("  95 % within", f"{h.most:.3f} m"),
            ("  greatest", f"{h.greatest:+.2f} m at x {h.x:.1f}, y {h.y:.1f}"),
            ("  beyond three standard deviations", f"{100.0 * h.beyond:.1f} %"),
            ("Safe ground of it", f"{self.safe_first:.0f} m² -> {self.safe_second:.0f} m²"),
            ("  gained / lost", f"{self.gained:.0f} m² / {self.lost:.0f} m²"),
        ]
        pairs = ", ".join(f"{a} -> {b}" for a, b in self.sites_kept)
        lines = [*aligned(rows, "<"), f"Sites kept: {pairs or 'none'}"]
        for name, sites in (("gained", self.sites_gained), ("lost", self.sites_lost)):
            for site in sites:
                place = f"x {site.x:.2f}, y {site.y:.2f}"
                lines.append(f"Site {name}: rank {site.rank} at {place}; {site.elsewhere}")
        return "\n".join(lines)


def compare_results(first: Results | str | Path, second: Results | str | Path) -> Comparison:
    """Compare two results, or their folders, at the grid points of the first. Raises
    `ResultsError`: a folder does not hold results, or they have no observed ground in common."""
    a, b = (r if isinstance(r, Results) else load_results(r) for r in (first, second))
    grid = a.grid
    both = grid.seen & _sample(b.grid, b.grid.seen, grid.x, grid.y)
    seen_in_first = _sample(grid, grid.seen, b.grid.x, b.grid.y)
    y, x = np.meshgrid(grid.y, grid.x, indexing="ij")
    one, other = a.map.at(x, y), b.map.at(x, y)
    difference = np.where(both, other.height - one.height, np.nan)
    known = np.isfinite(difference)
    if not known.any():
        raise ResultsError(f"{a.folder} and {b.folder} have no observed ground in common")
    area = float(grid.spacing**2)
    safe_a = both & grid["safe"]
    safe_b = both & _sample(b.grid, b.grid["safe"], grid.x, grid.y)
    kept, lost, gained = _sites(a, b)
    sigma = np.hypot(one.deviation, other.deviation)
    return Comparison(
        first=a,
        second=b,
        heights=_heights(difference, sigma, x, y, other.height),
        safe_first=area * np.count_nonzero(safe_a),
        safe_second=area * np.count_nonzero(safe_b),
        gained=area * np.count_nonzero(safe_b & ~safe_a),
        lost=area * np.count_nonzero(safe_a & ~safe_b),
        seen_first=area * np.count_nonzero(grid.seen & ~both),
        seen_second=b.grid.spacing**2 * np.count_nonzero(b.grid.seen & ~seen_in_first),
        sites_kept=kept,
        sites_gained=gained,
        sites_lost=lost,
    )


def _sample(grid: Grid, values: NDArray[Any], x: Array, y: Array) -> NDArray[Any]:
    """Sample a layer (ny, nx) at the grid points nearest to x, y; 0 outside the grid."""
    rows, columns = (
        np.rint((positions - axis[0]) / grid.spacing).astype(np.intp)
        for axis, positions in ((grid.y, y), (grid.x, x))
    )
    near = values.take(rows, axis=0, mode="clip").take(columns, axis=1, mode="clip")
    inside = ((rows >= 0) & (rows < grid.y.size))[:, None] & (columns >= 0)
    return np.where(inside & (columns < grid.x.size), near, 0).astype(values.dtype)


def _heights(difference: Array, sigma: Array, x: Array, y: Array, second: Array) -> Heights:
    known = np.isfinite(difference)
    values = difference[known]
    left, heights = values - values.mean(), (second[known] - values, second[known])
    worst = np.unravel_index(np.nanargmax(np.abs(difference)), difference.shape)
    with np.errstate(all="ignore"):  # NaN for level ground
        correlation = np.corrcoef(heights)[0, 1] if values.size > 1 else np.nan
    return Heights(
        points=int(values.size),
        mean=float(values.mean()),
        rms=float(np.sqrt(np.mean(values**2))),
        rms_mean_removed=float(np.sqrt(np.mean(left**2))),
        most=float(np.percentile(np.abs(values), 95.0)),
        greatest=float(difference[worst]),
        x=float(x[worst]),
        y=float(y[worst]),
        beyond=float(np.mean(np.abs(left) > SIGMAS * sigma[known])),
        correlation=float(correlation),
    )


def _sites(a: Results, b: Results) -> tuple[Any, tuple[Site, ...], tuple[Site, ...]]:
    """Return pairs of ranks, sites of only the first result, sites of only the second."""
    lss = a.config.lss
    reach = 0.5 * min(lss.vehicle.diameter, lss.vehicle.lengths.min_separation)
    one, other = a.positions, b.positions
    distance = np.hypot(*(one[:, None, :2] - other[None, :, :2]).transpose(2, 0, 1))
    pairs = []
    while distance.size and distance.min() <= reach:
        i, j = np.unravel_index(np.argmin(distance), distance.shape)
        pairs.append((int(i) + 1, int(j) + 1))
        distance[i, :] = distance[:, j] = np.inf
    lost = _unpaired(one, {i for i, _ in pairs}, b, "second")
    gained = _unpaired(other, {j for _, j in pairs}, a, "first")
    return tuple(sorted(pairs)), lost, gained


def _unpaired(positions: Array, paired: set[int], other: Results, name: str) -> tuple[Site, ...]:
    return tuple(
        Site(rank, *map(float, position), _describe(other.grid, *position[:2], name))
        for rank, position in enumerate(positions, start=1)
        if rank not in paired
    )


def _describe(grid: Grid, x: float, y: float, name: str) -> str:
    """Describe the assessment of a position in the ``name`` result."""
    place = np.array([x]), np.array([y])
    if not _sample(grid, np.ones_like(grid.seen), *place).all():
        return f"outside the {name}'s domain"
    if _sample(grid, grid["safe"], *place).all():
        return f"allowed in the {name}, but others rank before it"
    bits = int(_sample(grid, grid["hazard"], *place)[0, 0])
    bits &= ~UNSEEN if bits & UNMAPPED else 255
    kinds = ", ".join(kind for bit, kind, _ in sorted(HAZARDS) if bits & bit)
    return f"not allowed in the {name}{f' ({kinds})' if kinds else ', near a hazard'}"
