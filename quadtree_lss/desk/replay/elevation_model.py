# SPDX-License-Identifier: Apache-2.0
"""Landing sites on an elevation model: each cell between its posts is a leaf."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.desk.exchange.dem import MAX_POSTS, ElevationModel, read_dem
from quadtree_lss.desk.exchange.libraries import ExchangeError
from quadtree_lss.desk.replay.results import ReplayResult, run_summary, write_results
from quadtree_lss.onboard.config.settings import DEFAULTS, Config, config_from_values
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.errors import OutsideInput
from quadtree_lss.onboard.messages.landing_inputs import LandingRequests

#: Largest numbers of leaves and of grid points along a side.
MOST_CELLS, MOST_POINTS = 1 << 10, 2000


def rank_sites(
    dem: str | Path | ElevationModel,
    out: str | Path | None = None,
    config: Config = DEFAULTS,
    *,
    report: bool = True,
    landing: Mapping[str, ArrayLike | None] | None = None,
) -> ReplayResult:
    """Rank landing sites on an elevation model or its file (`read_dem`) and write the results.

    A leaf is a cell between posts, or several of them if there are more than 1024 x 1024. An area
    crops the model. ``config``: ``lss`` is used, and ``lidar.range_noise`` as the posts' standard
    deviation. ``out``, ``report`` and ``landing`` as in `replay.replay`. Raises `ExchangeError`:
    not an elevation model; `OutsideInput`: the target is outside of it; `ConfigError`: the
    configuration does not fit the model's size; `ReplayError`: the results cannot be written.
    """
    began = time.perf_counter()
    name = "" if isinstance(dem, ElevationModel) else str(Path(dem).resolve())
    model = dem if isinstance(dem, ElevationModel) else read_dem(Path(dem))
    wanted = {key: value for key, value in (landing or {}).items() if value is not None}
    if "area" in wanted:
        corners = np.asarray(wanted["area"], np.float64)
        room = 0.5 * config.lss.vehicle.diameter + config.lss.margin + 2.0 * model.spacing
        part = model.within(corners.min(axis=0) - room, corners.max(axis=0) + room)
        model = part if min(len(part.x), len(part.y)) >= 3 else model
    if "target" in wanted:
        x, y = np.asarray(wanted["target"], np.float64)[:2]
        if not (model.x[0] <= x <= model.x[-1] and model.y[0] <= y <= model.y[-1]):
            extent = f"x {model.x[0]:g} to {model.x[-1]:g}, y {model.y[0]:g} to {model.y[-1]:g} m"
            raise OutsideInput(f"the target {x:g},{y:g} is outside the model: {extent}")
    long, across = max(len(model.x), len(model.y)), min(len(model.x), len(model.y))
    if long**2 > MAX_POSTS:
        msg = f"{name or 'elevation model'}: {long} x {across} posts lie in a square of {long}^2;"
        msg += f" {MAX_POSTS} posts is the most (an area, or gdal_translate -srcwin, cuts it)"
        raise ExchangeError(msg)
    cells, block = cells_of(model, config.lidar.range_noise)
    names = ("xmin", "ymin", "size", "min_level", "max_level")
    own: dict[str, Any] = {f"domain.{name}": getattr(cells.domain, name) for name in names}
    own["domain.follow"] = "none"
    coarsest = cells.domain.size / MOST_POINTS
    if config.lss.spacing < coarsest:
        own["lss.grid_spacing"] = coarsest
    config = config_from_values(own, config)
    asked = time.perf_counter()
    requests = LandingRequests(None, wanted)
    found = LandingSiteSelector(config).assess(cells, **requests.arguments())
    lss_ms = 1e3 * (time.perf_counter() - asked)
    heights = model.elevation[np.isfinite(model.elevation)]
    upward = np.median(cells.normal[cells.measured, 2]) if cells.measured.any() else np.nan
    summary = run_summary(
        cells,
        found,
        config,
        lss_ms,
        landing=requests.as_lists(),
        bag=name,
        posts=[len(model.x), len(model.y)],
        post_spacing=model.spacing,
        height_range=[float(heights.min()), float(heights.max())],
        median_slope_deg=float(np.degrees(np.arccos(upward))),
        crs=model.crs,
        duration=time.perf_counter() - began,
        warnings=[*found.warnings, *_notes(model, block)],
    )
    result = ReplayResult(None if out is None else Path(out), cells, found, (), summary)
    if result.out is not None:
        write_results(result.out, result, config, report)
    return result


def _notes(model: ElevationModel, block: int) -> list[str]:
    many = f"a leaf has {block} x {block} of the model's cells, which are too many for a map;"
    many += " an area (--area) cuts the model to it"
    coarse = f"posts are {model.spacing:g} m apart: what is smaller, as rocks, is not in the model"
    return [many] * (block > 1) + [coarse] * (model.spacing > 0.5)


def cells_of(model: ElevationModel, deviation: float) -> tuple[CellMap, int]:
    """Make a map with leaves of one level; also return the cells of the model along a leaf's side.

    Each plane is fitted to the leaf's posts, whose standard deviation is ``deviation``, m; a leaf
    that lacks a post is not estimated.
    """
    count = max(len(model.x), len(model.y)) - 1
    block = max(-(-count // MOST_CELLS), 1)
    level = max(int(np.ceil(np.log2(-(-count // block)))), 0)
    side = block * model.spacing
    domain = Domain(float(model.x[0]), float(model.y[0]), side * 2**level, 0, level)
    n = 1 << level
    heights = np.full((n * block + 1,) * 2, np.nan)
    heights[: len(model.y), : len(model.x)] = model.elevation
    steps = (np.arange(block + 1) / block - 0.5) * side
    posts = (block + 1) ** 2
    spread = float(np.sum(steps**2) * (block + 1))
    of_leaves = [  # each post of all leaves: its place in them, and heights (n, n)
        (x, y, heights[j : j + n * block : block, i : i + n * block : block])
        for j, y in enumerate(steps)
        for i, x in enumerate(steps)
    ]
    middle = sum(z for _, _, z in of_leaves) / posts
    slope_x = sum(z * x for x, _, z in of_leaves) / spread
    slope_y = sum(z * y for _, y, z in of_leaves) / spread
    left = ((z - middle - slope_x * x - slope_y * y) ** 2 for x, y, z in of_leaves)
    square = (sum(left) / posts).ravel()  # NaN, as the other two, where a post lacks
    iy, ix = np.divmod(np.arange(n * n), n)
    known = np.isfinite(middle).ravel()
    normal = np.stack([-slope_x.ravel(), -slope_y.ravel(), np.ones(n * n)], axis=-1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    variance = (deviation**2 + square)[:, None, None]
    covariance = variance * np.diag([1.0 / spread, 1.0 / spread, 1.0 / posts])
    cells = CellMap(
        stamp_ns=1,
        domain=domain,
        level=np.full(n * n, level, np.uint8),
        ix=ix.astype(np.uint32),
        iy=iy.astype(np.uint32),
        z=middle.ravel(),
        normal=normal,
        covariance_range=covariance,
        covariance_pose=0.0 * covariance,
        count=np.where(known, posts, 0).astype(np.uint32),
        measured=known,
        roughness=side**2 * np.sqrt(square),
        exception_fraction=0.0 * square,
        feature=np.full((n * n, 5), np.nan),
        low=np.full(n * n, np.nan),
        high=np.full(n * n, np.nan),
        coverage=known.astype(np.float64),
        observed=known.reshape(n, n),
        known=known.reshape(n, n),
    )
    return cells, block
