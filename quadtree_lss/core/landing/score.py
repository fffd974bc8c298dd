# SPDX-License-Identifier: Apache-2.0
"""Safety and score of every grid point of the finest lattice (paper V.D)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.config.settings import LssConfig
from quadtree_lss.core.landing import hazards
from quadtree_lss.core.landing.lattice import (
    Disc,
    GroundPlanes,
    disc,
    disc_means,
    distance_from,
    ground_planes,
    grown,
    mean_of_corners,
    touching,
)
from quadtree_lss.core.landing.raster import TerrainRaster
from quadtree_lss.core.tree.cell_map import CellMap
from quadtree_lss.core.tree.domain import Domain

Array = NDArray[np.float64]
Bits = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class PointAssessment:
    """What the assessment finds at the grid points of the finest lattice, (n + 1, n + 1).

    Attributes:
        planes: Ground at the lander's scale.
        slope: Its angle, rad.
        hazard: Bits of ``hazards``.
        safe: Landing there is allowed by the ground.
        score: Eq. 59.
        roughness: Of the finest cells, (n, n), m.
        subscale: Greatest height of a subscale feature within each of them, (n, n), m.
        zone: Which finest cells a zone covers.
        spoiled: What the zone must keep off: finest cells (n, n) by the paper's rules, grid points
            at which the lander fails with the touchdown check ...
        reach: ... and how near the zone's centre may come to them, m.
        unseen: (n, n) finest cells the zone must keep off.
    """

    planes: GroundPlanes
    slope: Array
    hazard: Bits
    safe: Mask
    score: Array
    roughness: Array
    subscale: Array
    zone: Disc
    spoiled: Mask
    reach: float
    unseen: Mask


def assess_points(
    cells: CellMap,
    raster: TerrainRaster,
    features: Bits,
    inside: Array,
    fails: Mask,
    lss: LssConfig,
) -> PointAssessment:
    """Safety and score on the finest lattice.

    Args:
        cells, raster: The map.
        features: (M,) of ``hazards.avoided_features``.
        inside: (n + 1, n + 1) of ``seen_about``.
        fails: (n + 1, n + 1) of the touchdown check.
        lss: Limits and weights.
    """
    side = cells.domain.finest_size
    radius = 0.5 * lss.vehicle_diameter
    zone = radius + lss.margin
    bits = np.where(raster.seen, features.take(raster.leaf), np.uint8(0))
    # No zone fits a domain smaller than itself: none needs sums over more than that.
    widest = 0.5 * cells.domain.size
    planes = ground_planes(raster.elevation, side, min(ground_radius(lss), widest))
    slope = np.arctan(np.sqrt(planes.slope_x**2 + planes.slope_y**2))
    hazard = touching(bits)
    if lss.assessment == "touchdown":
        landable = inside >= radius - 1e-9
        excepted = touching(bits & np.uint8(hazards.EXCEPTION)) > 0
        spoiled = fails | (landable & grown(excepted, radius, side))
        # Rounded outwards: a map that may be off at all is off by a grid point.
        steps = np.ceil(lss.hazard_growth / side - 1e-9)
        spoiled |= landable & grown(spoiled, steps * side, side)
        hazard |= spoiled * np.uint8(hazards.TOUCHDOWN)
        safe = ~grown(spoiled, lss.margin, side)
        # Ground that spoils a landing lies about a radius from the points it makes unsafe.
        near, reach = distance_from(spoiled, side) + radius, lss.margin
        of_points, of_leaves = lss.weight_slope * slope, np.zeros(len(cells.level))
    else:
        spoiled = bits > 0
        safe = ~grown(hazard > 0, zone, side)
        near, reach = distance_from(hazard > 0, side), zone
        of_points, of_leaves = 0.0 * slope, lss.weight_slope * hazards.slope(cells.normal)
    safe &= inside >= zone - 1e-9
    near = np.minimum(np.minimum(near, inside), lss.hazard_distance_cap)
    hazard |= (touching((~raster.seen).view(np.uint8)) > 0) * np.uint8(hazards.UNSEEN)
    over = disc(min(zone, widest), side)
    # Eq. 55 is a volume and grows with the leaf: over its area it is a height.
    rough = np.nan_to_num(cells.roughness / cells.size**2)
    of_leaves += lss.weight_roughness * rough
    # Eq. 58 on the finest cells; Eq. 56's integral as Eq. 59's mean over the disc of each point.
    density = mean_of_corners(of_points - lss.weight_hazard_distance * near)
    density += np.nan_to_num(of_leaves).take(raster.leaf)
    density += lss.weight_subscale * raster.subscale
    return PointAssessment(
        planes,
        slope,
        hazard,
        safe,
        disc_means(density, over),
        rough.take(raster.leaf),
        raster.subscale_peak,
        over,
        spoiled,
        reach,
        ~raster.firm,
    )


def ground_radius(lss: LssConfig) -> float:
    """Radius of the ground at the lander's scale, m."""
    return 0.75 * 0.5 * lss.vehicle_diameter


def seen_about(raster: TerrainRaster) -> Array:
    """Distance of grid points to ground that is unseen or outside, m."""
    n, side = raster.domain.finest_count, raster.domain.finest_size
    border = np.minimum(np.arange(n + 1), np.arange(n, -1, -1)) * side
    unseen = touching((~raster.firm).view(np.uint8)) > 0
    return np.minimum(np.minimum(border[:, None], border), distance_from(unseen, side))


def room_about(points: PointAssessment, domain: Domain, zone: float, x: Array, y: Array) -> Array:
    """How far a zone of radius ``zone`` centred at x, y (K,) may move in any direction, (K,), m.

    That is until it touches a hazard (or, with the touchdown check, until the lander fails within
    the margin), unseen ground or the domain's border. 0 where it does.
    """
    x, y = x - domain.xmin, y - domain.ymin
    out = np.minimum(np.minimum(x, domain.size - x), np.minimum(y, domain.size - y)) - zone
    for marked, reach in ((points.spoiled, points.reach), (points.unseen, zone)):
        row, column = np.nonzero(marked & ~_surrounded(marked))
        if not len(row):
            continue
        # Cells have an extent, points of the lattice have none.
        half = 0.5 * (domain.finest_count + 1 - len(marked))
        for k in range(len(x)):
            dx = np.maximum(np.abs(x[k] / domain.finest_size - column - half) - half, 0.0)
            dy = np.maximum(np.abs(y[k] / domain.finest_size - row - half) - half, 0.0)
            away = np.sqrt((dx * dx + dy * dy).min()) * domain.finest_size
            out[k] = min(out[k], away - reach)
    return np.maximum(out, 0.0)


def _surrounded(marked: Mask) -> Mask:
    """Marked places between marked ones on all four sides."""
    out = np.zeros_like(marked)
    out[1:-1, 1:-1] = marked[:-2, 1:-1] & marked[2:, 1:-1] & marked[1:-1, :-2] & marked[1:-1, 2:]
    return out


def greatest_in_zones(values: Array, over: Disc, rows: Index, columns: Index) -> Array:
    """Greatest value (K,) of the cells (n, n) in the disc about grid points (K,) in the domain."""
    last = len(values) - 1
    out = np.empty(len(rows))
    for k in range(len(rows)):  # all at once they would be many arrays of zones
        row, column = (
            np.clip(rows[k] + over.row, 0, last),
            np.clip(columns[k] + over.column, 0, last),
        )
        out[k] = values[row, column].max()
    return out
