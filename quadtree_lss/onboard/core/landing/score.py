# SPDX-License-Identifier: Apache-2.0
"""Step 3 of an assessment: hazards, safety and score of each grid point (paper V.D)."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, radians, tan

import cython
import numpy as np

from quadtree_lss.onboard.arrays import Array, Bytes, Mask
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing import hazards
from quadtree_lss.onboard.core.landing.contact import Contacts, touchdown_limits
from quadtree_lss.onboard.core.landing.lattice import (
    corner_bits,
    dilate,
    disc,
    disc_means,
    distance_from,
)
from quadtree_lss.onboard.core.landing.raster import DISTANCE_CAP, RELATIVE_ROUNDING, TerrainRaster
from quadtree_lss.onboard.core.landing.risk import RiskTable

#: Weights of Eq. 58, which the paper does not give: alpha_theta, per radian; alpha_R, per metre of
#: roughness over the leaf's area, so that 1 cm equals 1 degree of slope; alpha_H, per metre of
#: distance to a hazard; alpha_s, per metre of subscale height. Lengths are those of the default
#: vehicle, in proportion for others.
WEIGHT_SLOPE, WEIGHT_ROUGHNESS, WEIGHT_DISTANCE, WEIGHT_SUBSCALE = 1.0, 2.0, 0.02, 1.0
UPRIGHT = cython.declare(cython.double, 0.5 * pi)


@dataclass(frozen=True)
class PointAssessment:
    """Risk, safety and score at the grid points of the finest lattice, (n + 1, n + 1).

    Attributes:
        risk: Predicted risk, NaN without a risk model.
        cause: Main cause of the risk (see `RiskTable.risk`).
        hazard: Bits of ``hazards``.
        safe: The ground allows landing.
        score: Eq. 59.
        clearance: How far the landing zone can move until it touches excluded ground, m, up to
            `DISTANCE_CAP`; negative where landing is excluded.
        roughness: (M,) of the leaves: Eq. 55's volume over the area, m.
        excluded: Finest cells (n, n) with the paper's rules, or grid points with the others, from
            which the zone must keep a distance ...
        distance: ... and that distance, from the zone's centre, m.
    """

    raster: TerrainRaster
    risk: Array
    cause: Bytes
    hazard: Bytes
    safe: Mask
    score: Array
    clearance: Array
    roughness: Array
    excluded: Mask
    distance: float


def assess_points(
    raster: TerrainRaster, contacts: Contacts | None, table: RiskTable | None, lss: LssConfig
) -> PointAssessment:
    """Compute risk, safety and score of each grid point.

    ``contacts``: needed without the paper's rules, or with a risk model. ``table``: that model.
    """
    cells, side = raster.cells, raster.domain.finest_size
    vehicle, radius, zone = lss.vehicle, 0.5 * lss.vehicle.diameter, lss.zone
    cap = DISTANCE_CAP * vehicle.diameter_ratio
    bits = hazards.avoided_features(cells, lss).take(raster.leaf)
    bits *= raster.observed.view(np.uint8)
    bits |= raster.unknown_bits
    hazard = corner_bits(bits)
    if table is not None and contacts is not None:
        risk, cause = table.risk(raster, contacts)
    else:
        risk, cause = np.full(hazard.shape, np.nan), np.zeros_like(hazard)
    if contacts is None or lss.assessment == "paper":
        excluded, distance = bits & hazards.FEATURE > 0, zone
        near_feature = hazard & hazards.FEATURE > 0
        safe = ~dilate(near_feature, zone, side)
        near = distance_from(near_feature, side, cap)
        east, north, up = cells.normal.T
        slope = np.arctan2(np.hypot(east, north), up)  # Eq. 54
        slope_weight, leaf_part = 0.0, np.nan_to_num(WEIGHT_SLOPE * slope)
    else:
        excepted = dilate(hazard & hazards.EXCEPTION > 0, radius, side)
        if lss.assessment == "touchdown":
            limits = touchdown_limits(lss)
            excluded = contacts.rise > np.float32(limits.min_rise)
            excluded |= contacts.tilt > np.float32(limits.max_tilt)
            excluded = raster.assessable & (excluded | excepted)
            # Any displacement of the map is at least one grid point.
            steps = np.ceil(vehicle.lengths.hazard_growth / side - RELATIVE_ROUNDING)
            excluded |= raster.assessable & dilate(excluded, steps * side, side)
        else:
            fails = raster.assessable & (risk > lss.max_risk)
            excluded = fails | (raster.assessable & excepted)
            stands = contacts.rise <= vehicle.clearance
            stands &= contacts.tilt <= tan(radians(vehicle.max_slope_deg))
            hazard |= (fails & stands) * np.uint8(hazards.UNCERTAIN)
        safe, distance = ~dilate(excluded, lss.margin, side), lss.margin
        hazard |= ~safe * np.uint8(hazards.TOUCHDOWN)
        # The ground that makes a touchdown fail is about a radius from the grid point.
        near = distance_from(excluded, side, cap - (1.0 - RELATIVE_ROUNDING) * radius)
        near += radius
        slope_weight, leaf_part = WEIGHT_SLOPE, np.zeros(len(cells.level))
    fits = raster.free_distance >= (1.0 - RELATIVE_ROUNDING) * zone
    safe &= fits
    partly = ~fits & (hazard & hazards.UNSEEN == 0)
    hazard |= partly * np.uint8(hazards.PARTLY_UNOBSERVED)
    clearance = np.minimum(np.minimum(near, cap), raster.free_distance) - zone
    # Eq. 55 is a volume that grows with the leaf; divided by its area it is a height.
    rough = cells.roughness / cells.size**2
    rough[np.isnan(rough)] = 0.0
    leaf_part += WEIGHT_ROUGHNESS / vehicle.clearance_ratio * rough
    per_metre = WEIGHT_DISTANCE / vehicle.diameter_ratio
    weights = slope_weight, per_metre, WEIGHT_SUBSCALE / vehicle.clearance_ratio
    density = np.empty(raster.leaf.shape)
    set_densities(raster, near, leaf_part, cap, weights, density)
    # Eq. 56's integral is Eq. 59's mean over the disc of each point. A zone larger than the domain
    # fits nowhere, so its disc is limited.
    score = disc_means(density, disc(min(zone, 0.5 * cells.domain.size), side), raster.observed)
    return PointAssessment(
        raster, risk, cause, hazard, safe, score, clearance, rough, excluded, distance
    )


@cython.boundscheck(False)
@cython.locals(near=cython.double[:, ::1], leaf_part=cython.double[::1], cap=cython.double)
@cython.locals(out=cython.double[:, ::1], per_slope=cython.double, per_metre=cython.double)
@cython.locals(per_height=cython.double)
def set_densities(
    raster: TerrainRaster,
    near: Array,
    leaf_part: Array,
    cap: float,
    weights: tuple[float, float, float],
    out: Array,
) -> None:
    """Set ``out`` (n, n) to Eq. 58 of each finest cell: mean over its grid points, plus its leaf.

    ``near``: (n + 1, n + 1) distances to hazards, m, of which no more than ``cap`` matters.
    ``leaf_part``: (M,) constant over a leaf. ``weights``: of slope, distance, subscale height.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    n: cython.Py_ssize_t = out.shape[0]
    per_slope, per_metre, per_height = weights
    gradient = cython.declare(cython.double[:, ::1], raster.planes.gradient)
    free_distance = cython.declare(cython.double[:, ::1], raster.free_distance)
    leaf = cython.declare(cython.Py_ssize_t[:, ::1], raster.leaf)
    subscale = cython.declare(cython.double[:, ::1], raster.subscale)
    before = cython.declare(cython.double[::1], np.zeros(n + 1))
    both = cython.declare(cython.double[::1], np.empty(n + 1))
    with cython.nogil:
        for i in range(n + 1):
            for j in range(n + 1):
                free: cython.double = near[i, j]
                free = free if free < free_distance[i, j] else free_distance[i, j]
                # Arc tangent with an error of 1e-5 (Hastings 1955), which vectorises.
                x = gradient[i, j] if gradient[i, j] < 1.0 else 1.0 / gradient[i, j]
                z = x * x
                z = 0.180141 + z * (-0.085133 + z * 0.0208351)
                z = x * (0.999866 + x * x * (-0.3302995 + x * x * z))
                z = z if gradient[i, j] < 1.0 else UPRIGHT - z
                free = per_slope * z - per_metre * (free if free < cap else cap)
                both[j] = before[j] + free
                before[j] = free
            if i == 0:
                continue
            for j in range(n):
                out[i - 1, j] = 0.25 * (both[j] + both[j + 1]) + leaf_part[leaf[i - 1, j]]
                out[i - 1, j] += per_height * subscale[i - 1, j]
