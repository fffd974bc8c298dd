# SPDX-License-Identifier: Apache-2.0
"""Safety and score of every grid point of the finest lattice (paper V.D)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadtree_lss.onboard.arrays import Array, Bytes, Index, Mask
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing import hazards
from quadtree_lss.onboard.core.landing.lattice import (
    Disc,
    GroundPlanes,
    disc,
    disc_means,
    distance_from,
    ground_planes,
    grown,
    touching,
)
from quadtree_lss.onboard.core.landing.raster import TerrainRaster
from quadtree_lss.onboard.core.landing.sweeps import score_density
from quadtree_lss.onboard.core.landing.zones import greatest_in_zones, lower_room
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.domain import Domain

#: Weights of Eq. 58, of which the paper prints none: alpha_theta, per radian; alpha_R, per metre of
#: roughness over the leaf's area, so that a centimetre counts like a degree of slope; alpha_H, per
#: metre of distance to a hazard; alpha_s, per metre of subscale height.
WEIGHT_SLOPE, WEIGHT_ROUGHNESS, WEIGHT_DISTANCE, WEIGHT_SUBSCALE = 1.0, 2.0, 0.02, 1.0
#: Farther hazards do not improve a score, m.
DISTANCE_CAP = 10.0


@dataclass(frozen=True)
class PointAssessment:
    """What the assessment finds at the grid points of the finest lattice, (n + 1, n + 1).

    Attributes:
        planes: Ground at the lander's scale.
        hazard: Bits of ``hazards``.
        safe: Landing there is allowed by the ground.
        score: Eq. 59.
        roughness: (M,) of the leaves, Eq. 55's volume over the area, m.
        raster: The map.
        zone: Which finest cells a zone covers.
        spoiled: What the zone must keep off: finest cells (n, n) by the paper's rules, grid points
            at which the lander fails with the touchdown check ...
        reach: ... and how near the zone's centre may come to them, m.
        unseen: (n, n) finest cells the zone must keep off ...
        pad_radius: ... and by how much more of those that are seen but not yet mapped, m.
    """

    planes: GroundPlanes
    hazard: Bytes
    safe: Mask
    score: Array
    roughness: Array
    raster: TerrainRaster
    zone: Disc
    spoiled: Mask
    reach: float
    unseen: Mask
    pad_radius: float


def assess_points(
    cells: CellMap,
    raster: TerrainRaster,
    planes: GroundPlanes,
    features: Bytes,
    inside: Array,
    fails: Mask,
    lss: LssConfig,
) -> PointAssessment:
    """Safety and score on the finest lattice.

    Args:
        cells, raster: The map.
        planes: Of ``planes_below``.
        features: (M,) of ``hazards.avoided_features``.
        inside: (n + 1, n + 1) of ``seen_about``.
        fails: (n + 1, n + 1) of the touchdown check, or where the risk is too great.
        lss: Limits and weights.
    """
    side = cells.domain.finest_size
    radius = 0.5 * lss.vehicle_diameter
    zone = radius + lss.margin
    bits = features.take(raster.leaf)
    bits *= raster.seen.view(np.uint8)
    bits |= unknown_bits(raster)
    # No zone fits a domain smaller than itself: none needs sums over more than that.
    widest = 0.5 * cells.domain.size
    hazard = touching(bits)
    if lss.assessment != "paper":
        landable = inside >= radius - 1e-9
        excepted = hazard & hazards.EXCEPTION > 0
        spoiled = fails | (landable & grown(excepted, radius, side))
        if lss.assessment == "touchdown":
            # Rounded outwards: a map that may be off at all is off by a grid point.
            steps = np.ceil(lss.hazard_growth / side - 1e-9)
            spoiled |= landable & grown(spoiled, steps * side, side)
        hazard |= spoiled * np.uint8(hazards.TOUCHDOWN)
        safe = ~grown(spoiled, lss.margin, side)
        # Ground that spoils a landing lies about a radius from the points it makes unsafe.
        near, reach = distance_from(spoiled, side, DISTANCE_CAP), lss.margin
        near += radius
        of_slope, of_leaves = WEIGHT_SLOPE, np.zeros(len(cells.level))
    else:
        spoiled = bits & hazards.FEATURE > 0
        near_feature = hazard & hazards.FEATURE > 0
        safe = ~grown(near_feature, zone, side)
        near, reach = distance_from(near_feature, side, DISTANCE_CAP), zone
        of_slope, of_leaves = 0.0, np.nan_to_num(WEIGHT_SLOPE * hazards.slope(cells.normal))
    safe &= inside >= zone - 1e-9
    over = disc(min(zone, widest), side)
    # Eq. 55 is a volume and grows with the leaf: over its area it is a height.
    rough = cells.roughness / cells.size**2
    rough[np.isnan(rough)] = 0.0
    of_leaves += WEIGHT_ROUGHNESS * rough
    # Eq. 58 on the finest cells; Eq. 56's integral as Eq. 59's mean over the disc of each point.
    density = np.empty(raster.leaf.shape)
    weights = of_slope, WEIGHT_DISTANCE, WEIGHT_SUBSCALE, DISTANCE_CAP
    score_density(
        planes.slope,
        near,
        inside,
        raster.subscale,
        raster.leaf,
        of_leaves,
        np.array(weights),
        density,
    )
    return PointAssessment(
        planes,
        hazard,
        safe,
        disc_means(density, over, raster.seen),
        rough,
        raster,
        over,
        spoiled,
        reach,
        ~raster.firm,
        lss.pad_radius,
    )


def ground_radius(lss: LssConfig) -> float:
    """Radius of the ground at the lander's scale, m."""
    return 0.75 * 0.5 * lss.vehicle_diameter


def planes_below(raster: TerrainRaster, lss: LssConfig) -> GroundPlanes:
    """The ground at the lander's scale, at all grid points of the finest lattice."""
    domain = raster.domain
    radius = min(ground_radius(lss), 0.5 * domain.size)
    return ground_planes(raster.elevation, raster.seen, domain.finest_size, radius)


def unknown_bits(raster: TerrainRaster) -> Bytes:
    """Bits (n, n) of finest cells of which nobody knows what is there."""
    bits = ~raster.seen * np.uint8(hazards.UNSEEN)
    bits |= raster.unmapped * np.uint8(hazards.UNMAPPED)
    return bits


def seen_about(raster: TerrainRaster, lss: LssConfig) -> Array:
    """Distance of grid points to ground that is unseen or outside, where that matters, m.

    Something was hit on ground that is seen but not yet mapped: pads must not reach over it
    either, so it is nearer by their radius.
    """
    limit = max(0.5 * lss.vehicle_diameter + lss.margin, DISTANCE_CAP)
    n, side = raster.domain.finest_count, raster.domain.finest_size
    border = np.minimum(np.arange(n + 1), np.arange(n, -1, -1)) * side
    out = distance_from(touching((~raster.firm).view(np.uint8)) > 0, side, limit)
    if raster.unmapped.any():
        marked = touching(raster.unmapped.view(np.uint8)) > 0
        near = distance_from(marked, side, limit + lss.pad_radius)
        np.minimum(out, near - lss.pad_radius, out=out)
    np.minimum(out, border, out=out)
    return np.minimum(out, border[:, None], out=out)


def room_about(points: PointAssessment, domain: Domain, zone: float, x: Array, y: Array) -> Array:
    """How far a zone of radius ``zone`` centred at x, y (K,) may move in any direction, (K,), m.

    That is until it touches a hazard (or, with the touchdown check, until the lander fails within
    the margin), unseen ground or the domain's border. 0 where it does.
    """
    x, y, side = x - domain.xmin, y - domain.ymin, domain.finest_size
    out = np.minimum(np.minimum(x, domain.size - x), np.minimum(y, domain.size - y)) - zone
    unmapped = (points.raster.unmapped, zone + points.pad_radius)
    for marked, reach in ((points.spoiled, points.reach), (points.unseen, zone), unmapped):
        # Cells have an extent, points of the lattice have none.
        half = 0.5 * (domain.finest_count + 1 - len(marked))
        lower_room(marked.view(np.uint8), half, x, y, side, reach, out)
    return np.asarray(np.maximum(out, 0.0))


def meets_unmapped(
    raster: TerrainRaster, row: int, column: int, radius: float, lss: LssConfig
) -> bool:
    """Whether pads on a circle (m) about a grid point of the lattice meet ground not yet mapped."""
    if not raster.unmapped.any():
        return False
    side, room = raster.domain.finest_size, np.zeros(1)
    place = np.array([column * side]), np.array([row * side])
    marked = raster.unmapped.view(np.uint8)
    lower_room(marked, 0.5, *place, side, radius + lss.pad_radius - 1e-9, room)
    return bool(room[0] < 0.0)


def greatest_about(points: PointAssessment, rows: Index, columns: Index) -> tuple[Array, Array]:
    """Greatest roughness and height of a subscale feature in zones about grid points (K,), m."""
    out = np.empty((2, len(rows)))
    peak, leaf, half = points.raster.subscale_peak, points.raster.leaf, points.zone.half
    greatest_in_zones(peak, leaf, points.roughness, half, np.stack([rows, columns]), out)
    return out[1], out[0]
