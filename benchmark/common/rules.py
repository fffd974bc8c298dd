# SPDX-License-Identifier: Apache-2.0
"""What the landing rules say of a map, and what is true, on the map's finest lattice."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import distance_transform_edt

from quadtree_lss.lab.evaluation.risk_fit import unfitted
from quadtree_lss.lab.evaluation.risk_flights import Landings, Mapped, land
from quadtree_lss.onboard.arrays import Array, Index, Mask
from quadtree_lss.onboard.config.risk import RiskModel
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.geometry.heights import height_by_error
from quadtree_lss.onboard.core.landing import hazards
from quadtree_lss.onboard.core.landing.lattice import grown
from quadtree_lss.onboard.core.landing.probability import RiskTable
from quadtree_lss.onboard.core.landing.raster import TerrainRaster, rasterise
from quadtree_lss.onboard.core.landing.sites import LandingSiteSelector
from quadtree_lss.onboard.core.landing.touchdown import Limits, TouchdownCheck
from quadtree_lss.onboard.core.tree.cell_map import CellMap

RULES = ("paper", "touchdown", "probability")
WIDE = unfitted()
#: Side of the tiles, m, whose failures are taken for independent: a rock spoils many grid points.
TILE = 8.0


@dataclass(frozen=True)
class Judged:
    """A map as it is judged, at the K grid points where all is seen and the truth is known.

    Attributes:
        failed: (K,) truly unsafe.
        risk: (K,) by the model.
        tile: (K,) number of the tile of the ground that it lies in.
        called: (K,) safe, by rule.
        first: By rule: clearance of the first site as a share of the best to be had; 0 if it is
            unsafe, NaN if there is none.
    """

    failed: Mask
    risk: Array
    tile: Index
    called: dict[str, Mask]
    first: dict[str, float]


def by_rule(config: Config, rule: str, **changes: object) -> Config:
    """A configuration that judges by a rule at all points of the lattice."""
    ranking = "probability" if rule == "probability" else "score"
    side = config.domain.size / 2**config.domain.max_level
    own: dict[str, object] = {"assessment": rule, "ranking": ranking, "grid_spacing": side}
    return replace(config, lss=replace(config.lss, **(own | changes)))


def judge(mapped: Mapped, model: RiskModel, config: Config, sites: bool) -> Judged:
    """Risk; with ``sites`` what the rules say as well."""
    landings = land(mapped, model, config)
    table = RiskTable(model, config.lss, landings.noise)
    risk = table.risk(landings.worst, landings.judged, landings.slope)[landings.counts]
    called, first = {}, {}
    for rule in RULES if sites else ():
        found = LandingSiteSelector(by_rule(config, rule)).assess(mapped.cells)
        called[rule] = found.safe[landings.counts]
        first[rule] = clearance(mapped, landings, found.sites.position)
    side = round(TILE / mapped.cells.domain.finest_size)
    row, column = np.argwhere(landings.counts).T // side
    return Judged(landings.failed, risk, 1000 * row + column, called, first)


def looks(before: Mapped, after: Mapped, config: Config) -> dict[str, tuple[int, int, int, int]]:
    """What a map calls ``uncertain`` or ``bad`` ground, and what the next one does: counts.

    Of grid points that both judge: allowed, uncertain and bad in the next, and truly unsafe.
    """
    bits = [
        LandingSiteSelector(by_rule(config, "probability", margin=0.0)).assess(one.cells).hazard
        for one in (before, after)
    ]
    known = after.known & (bits[0] & hazards.UNSEEN == 0) & (bits[1] & hazards.UNSEEN == 0)
    out = {}
    uncertain, failing = (
        [b & bit > 0 for b in bits] for bit in (hazards.UNCERTAIN, hazards.TOUCHDOWN)
    )
    for name, here in (("uncertain", uncertain[0]), ("bad", failing[0] & ~uncertain[0])):
        here = here & known
        then = (~failing[1], uncertain[1], failing[1] & ~uncertain[1], ~after.safe)
        out[name] = tuple(int((here & of).sum()) for of in then)
    return out


def clearance(mapped: Mapped, landings: Landings, sites: Array) -> float:
    """How far the first site is from truly unsafe ground, over the best that there is."""
    if not len(sites):
        return float("nan")
    room = distance_transform_edt(np.pad(mapped.safe & mapped.known, 1))[1:-1, 1:-1]
    domain = mapped.cells.domain
    at = np.rint((sites[0, :2] - [domain.xmin, domain.ymin]) / domain.finest_size).astype(int)
    return float(room[at[1], at[0]] / room[landings.counts].max())


def swept(mapped: Mapped, config: Config, rule: str, times: ArrayLike) -> Array:
    """Hazards found and safe ground kept (T, 2) by a rule whose limits are T times as wide."""
    landings, lss, out = land(mapped, WIDE, config), config.lss, []
    rise, slope = landings.worst.rise, landings.worst.slope
    for factor in np.asarray(times).tolist():
        if rule == "touchdown":
            steep = np.tan(np.radians(factor * lss.vehicle.lengths.touchdown_slope_deg))
            fails = (rise > factor * lss.vehicle.lengths.touchdown_roughness) | (slope > steep)
            side = mapped.cells.domain.finest_size
            safe = ~grown(fails & landings.judged, lss.growth, side)
        else:
            changes = {"max_slope_deg": factor * lss.vehicle.max_slope_deg}
            changes["clearance"] = factor * lss.vehicle.clearance
            other = replace(config, vehicle=replace(config.vehicle, **changes))
            selector = LandingSiteSelector(by_rule(other, rule))
            safe = selector.assess(mapped.cells).safe
        out.append(found_kept(safe[landings.counts], landings.failed))
    return np.array(out)


def found_kept(called: Mask, failed: Mask) -> tuple[float, float]:
    """Share of hazards found, and of safe ground kept."""
    return float((~called)[failed].mean()), float(called[~failed].mean())


def drawn(mapped: Mapped, config: Config, draws: int, seed: int) -> Array:
    """P(unsafe) (K,) by terrains drawn from the map's own errors, on which the lander is set down.

    A draw moves each leaf by its range noise, all leaves by one pose error of a usual leaf's
    covariance, and each finest cell by the roughness of its leaf.
    """
    rng, cells, lss = np.random.default_rng(seed), mapped.cells, config.lss
    raster = rasterise(cells, lss)
    landings = land(mapped, WIDE, config)
    steep = float(np.tan(np.radians(lss.vehicle.max_slope_deg)))
    check_at = Limits((lss.vehicle.clearance,) * 2, (steep,) * 2)
    failed = np.zeros(landings.judged.shape)
    for _ in range(draws):
        drawn_raster = _one_draw(rng, cells, raster)
        worst = TouchdownCheck(lss, check_at).worst(drawn_raster, landings.judged)
        failed += (worst.rise > np.float32(lss.vehicle.clearance)) | (
            worst.slope > np.float32(steep)
        )
    return np.asarray((failed[landings.counts] + 0.5) / (draws + 1.0))


def _one_draw(rng: np.random.Generator, cells: CellMap, raster: TerrainRaster) -> TerrainRaster:
    measured, zero = cells.measured, np.zeros(len(cells.z))
    common = np.median(cells.covariance_pose[measured], axis=0)
    errors = _normal(rng, np.where(measured[:, None, None], cells.covariance_range, 0.0))
    errors += _normal(rng, common[None])
    up = np.where(measured[:, None], cells.normal, [0.0, 0.0, 1.0])

    def rise(x: Array, y: Array) -> Array:
        return np.asarray(np.einsum("ij,ij->i", height_by_error(up, x, y), errors))

    shift, one = rise(zero, zero), zero + 1.0
    east, north = rise(one, zero) - shift, rise(zero, one) - shift
    rows, columns = np.indices(raster.leaf.shape)
    domain, leaf = raster.domain, raster.leaf
    x = domain.xmin + (columns + 0.5) * domain.finest_size - cells.x[leaf]
    y = domain.ymin + (rows + 0.5) * domain.finest_size - cells.y[leaf]
    rough = np.where(measured, np.nan_to_num(cells.roughness) / cells.size**2, 0.0)
    z = raster.elevation + shift[leaf] + east[leaf] * x + north[leaf] * y
    z += rough[leaf] * rng.standard_normal(z.shape)
    return replace(
        raster,
        elevation=z,
        slope_x=raster.slope_x + east[leaf],
        slope_y=raster.slope_y + north[leaf],
    )


def _normal(rng: np.random.Generator, covariance: Array) -> Array:
    """(M, 3) draws of (M, 3, 3) covariances."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.transpose(0, 2, 1)))
    scaled = np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(values.shape)
    return np.asarray(np.einsum("mij,mj->mi", vectors, scaled))
