# SPDX-License-Identifier: Apache-2.0
"""Landing sites on an elevation model, whose cells between posts become leaves."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.desk.exchange.dem import MAX_POSTS, ElevationModel, read_dem
from quadtree_lss.desk.exchange.formats import ExchangeError
from quadtree_lss.desk.replay.assessments import TargetChange
from quadtree_lss.desk.replay.results import ReplayResult, run_summary, write_results
from quadtree_lss.onboard.config.settings import DEFAULTS, Config, config_from_values
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.errors import OutsideInput
from quadtree_lss.onboard.messages.landing_inputs import LandingRequests

MAX_CELLS, MAX_GRID_POINTS = 1 << 10, 2000
"""Limits of the numbers of leaves and of grid points along a side."""


def rank_sites(
    dem: str | Path | ElevationModel,
    out: str | Path | None = None,
    config: Config = DEFAULTS,
    *,
    report: bool = True,
    landing: Mapping[str, ArrayLike | None] | None = None,
) -> ReplayResult:
    """Rank landing sites on an elevation model or its file (`read_dem`) and write the results.

    A leaf is a cell between posts, or a block of them if there are more than 1024 x 1024. An area
    crops the model. ``config``: ``lss`` is used, and ``lidar.range_noise`` as the posts' standard
    deviation. ``out``, ``report`` and ``landing`` as in `replay.replay`. Raises `ExchangeError`:
    not an elevation model; `OutsideInput`: the target is outside the model; `ConfigError`: the
    configuration does not fit the model's size; `ReplayError`: the results cannot be written.
    """
    began = time.perf_counter()
    name = "" if isinstance(dem, ElevationModel) else str(Path(dem).resolve())
    model = dem if isinstance(dem, ElevationModel) else read_dem(Path(dem))
    wanted = {key: value for key, value in (landing or {}).items() if value is not None}
    if "area" in wanted:
        corners = np.asarray(wanted["area"], np.float64)
        border = 0.5 * config.lss.vehicle.diameter + config.lss.margin + 2.0 * model.spacing
        part = model.within(corners.min(axis=0) - border, corners.max(axis=0) + border)
        model = part if min(len(part.x), len(part.y)) >= 3 else model
    if "target" in wanted:
        x, y = np.asarray(wanted["target"], np.float64)[:2]
        if not (model.x[0] <= x <= model.x[-1] and model.y[0] <= y <= model.y[-1]):
            extent = f"x {model.x[0]:g} to {model.x[-1]:g}, y {model.y[0]:g} to {model.y[-1]:g} m"
            raise OutsideInput(f"the target {x:g},{y:g} is outside the model: {extent}")
    shorter, longer = sorted((len(model.x), len(model.y)))
    if longer**2 > MAX_POSTS:
        need = f"{longer} x {shorter} posts need a square of {longer}^2"
        limit = f"the limit is {MAX_POSTS} posts (crop by an area or gdal_translate -srcwin)"
        raise ExchangeError(f"{name or 'elevation model'}: {need}; {limit}")
    cells, block = cells_of(model, config.lidar.range_noise)
    names = ("xmin", "ymin", "size", "min_level", "max_level")
    values: dict[str, Any] = {f"domain.{name}": getattr(cells.domain, name) for name in names}
    values["domain.follow"] = "none"
    least = cells.domain.size / MAX_GRID_POINTS
    if config.lss.spacing < least:
        values["lss.grid_spacing"] = least
    config = config_from_values(values, config)
    before = time.perf_counter()
    requests = LandingRequests(None, wanted)
    selector = LandingSiteSelector(config)
    found = selector.assess(cells, **requests.arguments())
    if found.pending:  # the ground of a model does not change: it confirms itself
        found = selector.assess(cells, **requests.arguments())
    lss_ms = 1e3 * (time.perf_counter() - before)
    heights = model.elevation[np.isfinite(model.elevation)]
    upward = np.median(cells.normal[cells.measured, 2]) if cells.measured.any() else np.nan
    coarse = (
        f"heights are {model.spacing:g} m apart: smaller rocks do not show, the risk may be low"
    )
    doubts = [*found.warnings, *[coarse] * (model.spacing > 0.5)]
    many = f"a leaf has {block} x {block} of the model's cells, which are too many for a map;"
    many += " an area (--area) cuts the model to it"
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
        doubts=doubts,
        warnings=[*doubts, *[many] * (block > 1)],
    )
    targets = (TargetChange.of(found),) * (found.selected.id > 0)
    result = ReplayResult(None if out is None else Path(out), cells, found, (), summary, targets)
    if result.out is not None:
        write_results(result.out, result, config, report)
    return result


def cells_of(model: ElevationModel, sigma: float) -> tuple[CellMap, int]:
    """Make a map with leaves of one level; also return the number of model cells along a leaf's
    side.

    Each plane is fitted to the leaf's posts, whose standard deviation is ``sigma``, m. A leaf with
    a missing post is not estimated.
    """
    count = max(len(model.x), len(model.y)) - 1
    block = max(-(-count // MAX_CELLS), 1)
    level = max(int(np.ceil(np.log2(-(-count // block)))), 0)
    side = block * model.spacing
    domain = Domain(float(model.x[0]), float(model.y[0]), side * 2**level, 0, level)
    n = 1 << level
    heights = np.full((n * block + 1,) * 2, np.nan)
    heights[: len(model.y), : len(model.x)] = model.elevation
    steps = (np.arange(block + 1) / block - 0.5) * side
    posts = (block + 1) ** 2
    spread = float(np.sum(steps**2) * (block + 1))
    offsets = [  # for each post of a leaf: x, y from the middle, and heights (n, n) of all leaves
        (x, y, heights[j : j + n * block : block, i : i + n * block : block])
        for j, y in enumerate(steps)
        for i, x in enumerate(steps)
    ]
    middle = sum(z for _, _, z in offsets) / posts
    slope_x = sum(z * x for x, _, z in offsets) / spread
    slope_y = sum(z * y for _, y, z in offsets) / spread
    residuals = ((z - middle - slope_x * x - slope_y * y) ** 2 for x, y, z in offsets)
    misfit = (sum(residuals) / posts).ravel()  # NaN, as the slopes, if a post is missing
    iy, ix = np.divmod(np.arange(n * n), n)
    known = np.isfinite(middle).ravel()
    normal = np.stack([-slope_x.ravel(), -slope_y.ravel(), np.ones(n * n)], axis=-1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    variance = (sigma**2 + misfit)[:, None, None]
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
        roughness=side**2 * np.sqrt(misfit),
        exception_fraction=0.0 * misfit,
        feature=np.full((n * n, 5), np.nan),
        low=np.full(n * n, np.nan),
        high=np.full(n * n, np.nan),
        coverage=known.astype(np.float64),
        observed=known.reshape(n, n),
        known=known.reshape(n, n),
    )
    return cells, block
