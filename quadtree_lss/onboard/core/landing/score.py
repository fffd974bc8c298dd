# SPDX-License-Identifier: Apache-2.0
"""The risk and the score of every grid point of the finest lattice (paper V.D)."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, radians, tan

import cython
import numpy as np
from cython.cimports.libc.math import fabs, sqrt

from quadtree_lss.onboard.arrays import Array, Bytes, Index, Mask
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing import hazards
from quadtree_lss.onboard.core.landing.contact import ContactCheck, Contacts
from quadtree_lss.onboard.core.landing.lattice import (
    GroundPlanes,
    disc,
    disc_means,
    distance_from,
    ground_planes,
    grown,
    touching,
    with_neighbours,
)
from quadtree_lss.onboard.core.landing.probability import RiskTable
from quadtree_lss.onboard.core.landing.raster import TerrainRaster

#: Weights of Eq. 58, of which the paper prints none: alpha_theta, per radian; alpha_R, per metre of
#: roughness over the leaf's area, so that a centimetre counts like a degree of slope; alpha_H, per
#: metre of distance to a hazard; alpha_s, per metre of subscale height. A metre is one of the
#: vehicle of the defaults: of others it is in proportion.
WEIGHT_SLOPE, WEIGHT_ROUGHNESS, WEIGHT_DISTANCE, WEIGHT_SUBSCALE = 1.0, 2.0, 0.02, 1.0
#: Farther hazards do not improve a score, m of that vehicle.
DISTANCE_CAP = 10.0
#: A share of a length that rounding may take.
SLACK = 1e-9
UPRIGHT = cython.declare(cython.double, 0.5 * pi)


@dataclass(frozen=True)
class Surroundings:
    """What lies about the grid points of the finest lattice, (n + 1, n + 1).

    Attributes:
        planes: The ground at the lander's scale.
        room: Distance to ground that is unseen or outside, where that matters, m. Something was
            hit on ground that is seen but not yet mapped: pads must not reach over it either, so
            it is nearer by their radius.
        to_unmapped: Distance to such ground, where that matters, m.
        judged: All ground under the lander is seen and mapped.
        needs_contact: These and their neighbours, as far as the vehicle fits into the domain. The
            risk at a grid point depends on contacts beside it, too.
    """

    planes: GroundPlanes
    room: Array
    to_unmapped: Array
    judged: Mask
    needs_contact: Mask


def ground_radius(lss: LssConfig) -> float:
    """Radius of the ground at the lander's scale, m."""
    return 0.75 * 0.5 * lss.vehicle.diameter


def look_around(raster: TerrainRaster, lss: LssConfig) -> Surroundings:
    """What lies about the grid points of a map."""
    domain = raster.domain
    n, side = domain.finest_count, domain.finest_size
    radius = min(ground_radius(lss), 0.5 * domain.size)
    planes = ground_planes(raster.elevation, raster.seen, side, radius)
    limit = max(lss.zone, DISTANCE_CAP * lss.vehicle.size)
    room = distance_from(touching((~raster.firm).view(np.uint8)) > 0, side, limit)
    unmapped = touching(raster.unmapped.view(np.uint8)) > 0
    farthest = max(lss.zone, 0.5 * lss.vehicle.diameter) + lss.vehicle.pad_radius + side
    to_unmapped = distance_from(unmapped, side, farthest)
    np.minimum(room, to_unmapped - lss.vehicle.pad_radius, out=room)
    border = np.minimum(np.arange(n + 1), np.arange(n, -1, -1)) * side
    np.minimum(room, border, out=room)
    np.minimum(room, border[:, None], out=room)
    needed = (0.5 - SLACK) * lss.vehicle.diameter
    judged, inside = room >= needed, border >= needed
    needs_contact = with_neighbours(judged) & inside & inside[:, None]
    return Surroundings(planes, room, to_unmapped, judged, needs_contact)


@dataclass(frozen=True)
class PointAssessment:
    """What the assessment finds at the grid points of the finest lattice, (n + 1, n + 1): ``risk``
    is P(unsafe) of landing there, NaN if nobody asked, ``contacts`` None likewise.

    Attributes:
        cause: What most of the risk comes from (see `RiskTable.risk`).
        hazard: Bits of ``hazards``.
        safe: Landing there is allowed by the ground.
        score: Eq. 59.
        clearance: How far the landing zone may move until it touches excluded ground, m; negative
            where landing is excluded. Capped.
        roughness: (M,) of the leaves, Eq. 55's volume over the area, m.
        spoiled: What the zone must keep off: finest cells (n, n) by the paper's rules, grid points
            at which the lander fails with the touchdown check ...
        reach: ... and how near the zone's centre may come to them, m.
    """

    raster: TerrainRaster
    around: Surroundings
    contacts: Contacts | None
    risk: Array
    cause: Bytes
    hazard: Bytes
    safe: Mask
    score: Array
    clearance: Array
    roughness: Array
    spoiled: Mask
    reach: float


def assess_points(
    raster: TerrainRaster,
    around: Surroundings,
    contacts: Contacts | None,
    check: ContactCheck | None,
    table: RiskTable | None,
    lss: LssConfig,
) -> PointAssessment:
    """Risk, safety and score on the finest lattice. The paper's rules need no contacts; the limits
    of ``check`` decide if ``lss.assessment`` is ``touchdown``; without ``table`` nobody asks for
    the risk."""
    cells, side = raster.cells, raster.domain.finest_size
    vehicle, radius, zone = lss.vehicle, 0.5 * lss.vehicle.diameter, lss.zone
    cap = DISTANCE_CAP * vehicle.size
    bits = hazards.avoided_features(cells, lss).take(raster.leaf)
    bits *= raster.seen.view(np.uint8)
    bits |= unknown_bits(raster)
    hazard = touching(bits)
    if contacts is not None and table is not None:
        risk, cause = table.risk(raster, around.judged, around.planes, contacts)
    else:
        risk, cause = np.full(hazard.shape, np.nan), np.zeros_like(hazard)
    if contacts is None or check is None or lss.assessment == "paper":
        spoiled = bits & hazards.FEATURE > 0
        near_feature = hazard & hazards.FEATURE > 0
        safe = ~grown(near_feature, zone, side)
        near, reach = distance_from(near_feature, side, cap), zone
        of_slope, of_leaves = 0.0, np.nan_to_num(WEIGHT_SLOPE * hazards.slope(cells.normal))
    else:
        excepted = grown(hazard & hazards.EXCEPTION > 0, radius, side)
        if lss.assessment == "touchdown":
            spoiled = around.judged & (check.exceeds_limits(contacts) | excepted)
            # Rounded outwards: a map that may be off at all is off by a grid point.
            steps = np.ceil(vehicle.lengths.hazard_growth / side - SLACK)
            spoiled |= around.judged & grown(spoiled, steps * side, side)
        else:
            fails = around.judged & (risk > lss.max_risk)
            spoiled = fails | (around.judged & excepted)
            stands = contacts.rise <= vehicle.clearance
            stands &= contacts.tilt <= tan(radians(vehicle.max_slope_deg))
            hazard |= (fails & stands) * np.uint8(hazards.UNCERTAIN)
        safe = ~grown(spoiled, lss.margin, side)
        hazard |= ~safe * np.uint8(hazards.TOUCHDOWN)
        # Ground that spoils a landing lies about a radius from the points it makes unsafe.
        near, reach = distance_from(spoiled, side, cap - (1.0 - SLACK) * radius), lss.margin
        near += radius
        of_slope, of_leaves = WEIGHT_SLOPE, np.zeros(len(cells.level))
    judged = around.room >= (1.0 - SLACK) * zone
    safe &= judged
    partly = ~judged & (hazard & hazards.UNSEEN == 0)
    hazard |= partly * np.uint8(hazards.PARTLY_UNOBSERVED)
    clearance = np.minimum(near, around.room)
    clearance -= zone
    # Eq. 55 is a volume and grows with the leaf: over its area it is a height.
    rough = cells.roughness / cells.size**2
    rough[np.isnan(rough)] = 0.0
    of_leaves += WEIGHT_ROUGHNESS / vehicle.height * rough
    weights = of_slope, WEIGHT_DISTANCE / vehicle.size, WEIGHT_SUBSCALE / vehicle.height
    density = np.empty(raster.leaf.shape)
    set_densities(raster, around, near, of_leaves, cap, weights, density)
    # Eq. 56's integral as Eq. 59's mean over the disc of each point. No zone fits a domain smaller
    # than itself: none needs sums over more than that.
    over = disc(min(zone, 0.5 * cells.domain.size), side)
    score = disc_means(density, over, raster.seen)
    return PointAssessment(
        raster,
        around,
        contacts,
        risk,
        cause,
        hazard,
        safe,
        score,
        clearance,
        rough,
        spoiled,
        reach,
    )


@cython.boundscheck(False)
@cython.locals(near=cython.double[:, ::1], of_leaves=cython.double[::1], cap=cython.double)
@cython.locals(out=cython.double[:, ::1], per_slope=cython.double, per_metre=cython.double)
@cython.locals(per_height=cython.double)
def set_densities(
    raster: TerrainRaster,
    around: Surroundings,
    near: Array,
    of_leaves: Array,
    cap: float,
    weights: tuple[float, float, float],
    out: Array,
) -> None:
    """Eq. 58, of the four grid points of each finest cell and of its leaf.

    Args:
        raster, around: The map, and what lies about its grid points.
        near: (n + 1, n + 1) distances to hazards, m.
        of_leaves: (M,) what is the same all over a leaf.
        cap: Farther hazards do not matter, m.
        weights: Of slope, distance and features.
        out: (n, n), set.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    n: cython.Py_ssize_t = out.shape[0]
    per_slope, per_metre, per_height = weights
    gradient = cython.declare(cython.double[:, ::1], around.planes.gradient)
    room = cython.declare(cython.double[:, ::1], around.room)
    leaf = cython.declare(cython.Py_ssize_t[:, ::1], raster.leaf)
    subscale = cython.declare(cython.double[:, ::1], raster.subscale)
    before = cython.declare(cython.double[::1], np.zeros(n + 1))
    both = cython.declare(cython.double[::1], np.empty(n + 1))
    with cython.nogil:
        for i in range(n + 1):
            for j in range(n + 1):
                free: cython.double = near[i, j] if near[i, j] < room[i, j] else room[i, j]
                # The arc tangent but for 1e-5 (Hastings 1955), several points at a time.
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
                out[i - 1, j] = 0.25 * (both[j] + both[j + 1]) + of_leaves[leaf[i - 1, j]]
                out[i - 1, j] += per_height * subscale[i - 1, j]


def unknown_bits(raster: TerrainRaster) -> Bytes:
    """Bits (n, n) of finest cells of which nobody knows what is there."""
    bits = ~raster.seen * np.uint8(hazards.UNSEEN)
    bits |= raster.unmapped * np.uint8(hazards.UNMAPPED)
    return bits


def zones_about(
    points: PointAssessment, centre: tuple[Index, Index], place: Array, lss: LssConfig
) -> tuple[Array, Array, Array]:
    """What is in the landing zones about places (K, 2), nearest to rows and columns of the lattice
    ``centre`` (K,), m, and how far these may move.

    Returns (K,) each, m: greatest roughness; greatest height of a subscale feature; how far the
    zone may move in any direction until it touches a hazard (or, with the touchdown check, until
    the lander fails within the margin), unseen ground or the domain's border, 0 where it does.
    """
    raster, domain, zone = points.raster, points.raster.domain, lss.zone
    side, last = domain.finest_size, domain.finest_count - 1
    over = disc(min(zone, 0.5 * domain.size), side)
    # A zone that reaches beyond the border has the cells at it.
    row = np.clip(centre[0][:, None] + over.row, 0, last)
    column = np.clip(centre[1][:, None] + over.column, 0, last)
    rough, raised = points.roughness[raster.leaf[row, column]], raster.subscale_peak[row, column]
    x, y = place[:, 0] - domain.xmin, place[:, 1] - domain.ymin
    room = np.minimum(np.minimum(x, domain.size - x), np.minimum(y, domain.size - y)) - zone
    unmapped = (raster.unmapped, zone + lss.vehicle.pad_radius)
    for marked, reach in ((points.spoiled, points.reach), (~raster.firm, zone), unmapped):
        # Cells have an extent, points of the lattice have none.
        half = 0.5 * (domain.finest_count + 1 - len(marked))
        lower_room(marked.view(np.uint8), half, x, y, side, reach, room)
    return rough.max(axis=1), raised.max(axis=1), np.maximum(room, 0.0)


@cython.boundscheck(False)
@cython.locals(marked=cython.uchar[:, ::1], x=cython.double[::1], y=cython.double[::1])
@cython.locals(room=cython.double[::1])
def lower_room(
    marked: Bytes, half: float, x: Array, y: Array, side: float, reach: float, room: Array
) -> None:
    """How far a zone at each of some places may move until it comes nearer than ``reach`` m to what
    is marked (ny, nx): cells (``half`` = 0.5) or points of a lattice of ``side`` m (0). ``x``,
    ``y`` (K,) are m from its first point; ``room`` (K,), m, is lowered."""
    cython.declare(k=cython.Py_ssize_t, i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    cython.declare(ring=cython.Py_ssize_t, row=cython.Py_ssize_t, column=cython.Py_ssize_t)
    farthest: cython.Py_ssize_t = max(marked.shape[0], marked.shape[1])
    with cython.nogil:
        for k in range(x.shape[0]):
            u, v = x[k] / side, y[k] / side
            column, row = cython.cast(cython.Py_ssize_t, u), cython.cast(cython.Py_ssize_t, v)
            ring = 0
            # What lies beyond a ring of places is at least as many steps away.
            while (ring - 1) * side - reach < room[k] and ring <= farthest:
                for i in range(row - ring, row + ring + 1):
                    if not 0 <= i < marked.shape[0]:
                        continue
                    j = column - ring
                    while j <= column + ring:
                        if 0 <= j < marked.shape[1] and marked[i, j]:
                            dx = max(fabs(u - j - half) - half, 0.0)
                            dy = max(fabs(v - i - half) - half, 0.0)
                            room[k] = min(room[k], sqrt(dx * dx + dy * dy) * side - reach)
                        j += 1 if i == row - ring or i == row + ring else 2 * ring
                ring += 1
