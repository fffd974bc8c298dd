# SPDX-License-Identifier: Apache-2.0
"""Light and reach as layers: where the sun does not come, and what the vehicle still gets to."""

from __future__ import annotations

from math import cos, floor, inf, isfinite, radians, sin

import numpy as np

from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.config.sections import LightConfig
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.geometry.polygons import signed_distance
from quadtree_lss.onboard.core.landing.now import reached
from quadtree_lss.onboard.core.landing.raster import TerrainRaster
from quadtree_lss.onboard.core.landing.target import Descent, Motion, Restrictions

#: m. Ground higher than a ray by less does not stop it.
GRAZING = 1e-9


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
    span = float(np.ptp(heights[known])) * abs(first)
    steps, turn = len(ground) - 1, abs(second / first) if first else 0.0
    if span < steps * spacing * up:
        steps = floor(span / (spacing * up))
    for k in range(1, steps + 1):
        whole = floor(aside := round(k * turn, 9))
        higher, part = ground[k:, whole:], aside - whole
        if part > 0.0:
            higher = (1.0 - part) * higher[:, :-1] + part * higher[:, 1:]
        at = slice(higher.shape[0]), slice(higher.shape[1])
        out[at] |= higher > ground[at] + (k * spacing * up / abs(first) + GRAZING)
    return dark & known


def in_shadow(raster: TerrainRaster, light: LightConfig) -> Mask:
    """(n, n) finest cells in shadow at touchdown or an hour later, subscale features included."""
    heights, side = raster.elevation + raster.subscale_peak, raster.domain.finest_size
    now, later = (
        shadow(
            heights,
            raster.seen,
            side,
            light.azimuth + hours * light.azimuth_rate,
            light.elevation + hours * light.elevation_rate,
        )
        for hours in (0.0, 1.0)
    )
    return now | later


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
