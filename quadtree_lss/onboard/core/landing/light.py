# SPDX-License-Identifier: Apache-2.0
"""Light and reach as layers: where the sun does not come, and what the vehicle still gets to."""

from __future__ import annotations

from math import cos, inf, isfinite, radians, sin

import cython
import numpy as np

from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.config.sections import LightConfig
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.geometry.polygons import signed_distance
from quadtree_lss.onboard.core.landing.now import reached
from quadtree_lss.onboard.core.landing.raster import TerrainRaster
from quadtree_lss.onboard.core.landing.target import Descent, Motion, Restrictions

#: m. Ground higher than a ray by less does not stop it.
GRAZING = cython.declare(cython.double, 1e-9)
#: Of a cell: so near to a middle a ray goes through it.
STRAIGHT = cython.declare(cython.double, 1e-9)


def shadow(heights: Array, known: Mask, spacing: float, azimuth: float, elevation: float) -> Mask:
    """(ny, nx) known ground that the sun does not reach.

    A ray from the middle of a cell, at height z, towards the sun is stopped where the ground is
    higher than z + s tan(elevation) at the distance s. It is looked at where the ray crosses a row
    of middles, or a column if it runs rather along x; between two middles the ground is straight.
    Unknown ground stops no ray, nor does what lies between it and its neighbour.

    Args:
        heights: (ny, nx) at the middles of cells, m; rows along y, columns along x.
        known: (ny, nx) where they are.
        spacing: Of the middles, m.
        azimuth: Of the sun, clockwise from north (y), deg.
        elevation: Of the sun, deg; all is in shadow from 0 down, and beyond 90 it stands behind.
    """
    up, level = sin(radians(elevation)), cos(radians(elevation))
    if up <= 0.0 or not known.any():
        return known.copy()
    x, y = level * sin(radians(azimuth)), level * cos(radians(azimuth))
    swap, dark = abs(x) > abs(y), np.zeros_like(known)
    first, second = (x, y) if swap else (y, x)  # along rows that the ray crosses, and across
    flips = (
        slice(None, None, -1 if first < 0.0 else 1),
        slice(None, None, -1 if second < 0.0 else 1),
    )
    ground, out = ((of.T if swap else of)[flips] for of in (np.where(known, heights, -inf), dark))
    if abs(first) > 0.0:
        rise, turn = spacing * up / abs(first), abs(second / first)
        out[...] = sweep(np.ascontiguousarray(ground), turn, rise, float(np.max(heights[known])))
    return dark & known


@cython.boundscheck(False)
@cython.locals(ground=cython.double[:, ::1], dark=cython.uchar[:, ::1])
@cython.locals(turn=cython.double, rise=cython.double, top=cython.double)
def sweep(ground: Array, turn: float, rise: float, top: float) -> Mask:
    """(ny, nx) whether something stops a ray that goes from row to row, the last ones first.

    Args:
        ground: (ny, nx) heights, m, -inf where unknown.
        turn: Columns by which the ray goes aside in a row, 0 to 1.
        rise: By which it rises in a row, m.
        top: Greatest height, m.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    found = np.zeros((ground.shape[0], ground.shape[1]), dtype=np.uint8)
    dark = found
    with cython.nogil:
        for i in range(ground.shape[0]):
            for j in range(ground.shape[1]):
                dark[i, j] = stopped(ground, i, j, turn, rise, top)
    return found.view(np.bool_)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.boundscheck(False)
def stopped(
    ground: cython.double[:, ::1],
    i: cython.Py_ssize_t,
    j: cython.Py_ssize_t,
    turn: cython.double,
    rise: cython.double,
    top: cython.double,
) -> cython.bint:
    """Of the ray from one place."""
    cython.declare(k=cython.Py_ssize_t, to=cython.Py_ssize_t)
    for k in range(1, ground.shape[0] - i):
        ray = ground[i, j] + k * rise + GRAZING
        to = j + cython.cast(cython.Py_ssize_t, k * turn + STRAIGHT)
        part = j + k * turn - to
        if ray > top or to + (part > STRAIGHT) >= ground.shape[1]:
            return False
        higher = ground[i + k, to]
        if part > STRAIGHT:
            higher = (1.0 - part) * higher + part * ground[i + k, to + 1]
        if higher > ray:
            return True
    return False


def in_shadow(raster: TerrainRaster, light: LightConfig) -> Mask:
    """(n, n) finest cells in shadow at touchdown or an hour later, subscale features included."""
    heights, side = raster.elevation + raster.subscale_peak, raster.domain.finest_size
    dark = shadow(heights, raster.seen, side, light.azimuth, light.elevation)
    if light.azimuth_rate or light.elevation_rate:
        later = light.azimuth + light.azimuth_rate, light.elevation + light.elevation_rate
        dark |= shadow(heights, raster.seen, side, *later)
    return dark


def within(
    x: Array,
    y: Array,
    wanted: Restrictions,
    lss: LssConfig,
    motion: Motion | None,
    descent: Descent | None,
) -> Mask | None:
    """(ny, nx) grid points within reach, None if nobody knows.

    As guidance gives it as the landing area, which holds the zone about each; without an area, as
    of ``now``, by the vehicle's place and speed.
    """
    if wanted.area is not None:
        zone = 0.5 * lss.vehicle.diameter + lss.margin
        try:
            return np.asarray(signed_distance(wanted.area, *np.meshgrid(x, y)) >= zone)
        except (TypeError, ValueError):
            return None
    if motion is None or not isfinite(motion.x):
        return None
    return reached(x, y, motion, descent, 0.0)
