# SPDX-License-Identifier: Apache-2.0
"""Hazards, safety and score of every node of the finest lattice (paper V.B to V.D)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.config.settings import LssConfig
from quadtree_lss.core.landing import hazards
from quadtree_lss.core.landing.distances import distance_from, grown
from quadtree_lss.core.landing.nodes import (
    Disc,
    NodePlanes,
    disc,
    node_means,
    node_planes,
    sum_of_corners,
    touching,
)
from quadtree_lss.core.landing.raster import TerrainRaster
from quadtree_lss.core.landing.touchdown import TouchdownCheck
from quadtree_lss.core.tree.quadtree import CellMap

Array = NDArray[np.float64]
Bits = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class Clearance:
    """How far ground that spoils a landing is from the nodes (n + 1, n + 1).

    Attributes:
        marked: Nodes that tell of a hazard ...
        beyond: ... which lies this much farther, m.
        unseen: Corners of unseen cells.
        side: Of a finest cell, m.
        cap: m.
        near: To the nearest hazard, or ground that is unseen or outside, up to ``cap``, m.
    """

    marked: Mask
    beyond: float
    unseen: Mask
    side: float
    cap: float
    near: Array

    @classmethod
    def measure(
        cls, marked: Mask, beyond: float, unseen: Mask, side: float, cap: float
    ) -> Clearance:
        """Distances up to a cap."""
        near = np.minimum(distance_from(marked, side, cap) + beyond, cap)
        np.minimum(near, seen_about(unseen, side, float(near.max())), out=near)
        return cls(marked, beyond, unseen, side, cap, near)

    def of_nodes(self, rows: Index, columns: Index) -> Array:
        """Distance (K,) whatever the cap, m."""
        out = self.near[rows, columns]
        if (out < self.cap).all() or np.isinf(self.cap):
            return out
        far = Clearance.measure(self.marked, self.beyond, self.unseen, self.side, np.inf)
        return far.of_nodes(rows, columns)


def seen_about(unseen: Mask, side: float, cap: float) -> Array:
    """Distance of nodes to ground that is unseen or outside, up to ``cap`` or farther, m."""
    lattice = np.arange(len(unseen))
    border = np.minimum(lattice, lattice[::-1]) * side
    out = np.minimum(border[:, None], border)
    return np.minimum(out, distance_from(unseen, side, cap), out=out)


@dataclass(frozen=True)
class NodeAssessment:
    """What the assessment finds on the lattice of finest-cell corners, (n + 1, n + 1).

    Attributes:
        planes: Ground at the lander's scale.
        slope: Its angle, rad.
        hazard: Bits of ``hazards``.
        safe: Landing there is allowed by the ground.
        score: Eq. 59.
        clearance: Distances to hazards.
        roughness: Of the finest cells, (n, n), m^3.
        subscale: Greatest height of a subscale feature within each of them, (n, n), m.
        zone: Which finest cells a zone covers.
    """

    planes: NodePlanes
    slope: Array
    hazard: Bits
    safe: Mask
    score: Array
    clearance: Clearance
    roughness: Array
    subscale: Array
    zone: Disc


def assess_nodes(
    cells: CellMap,
    raster: TerrainRaster,
    lss: LssConfig,
    leaf_hazards: hazards.LeafHazards,
    touchdown: TouchdownCheck,
) -> NodeAssessment:
    """Hazards, safety and score on the finest lattice."""
    side = cells.domain.finest_size
    radius = 0.5 * lss.vehicle_diameter
    zone = radius + lss.margin
    bits = np.where(raster.seen, leaf_hazards.of(cells).take(raster.leaf), np.uint8(0))
    planes = node_planes(raster, 0.75 * radius)
    slope = np.arctan(np.sqrt(planes.slope_x**2 + planes.slope_y**2))
    unseen = touching((~raster.firm).view(np.uint8)) > 0
    hazard = touching(bits)
    inside, cap = seen_about(unseen, side, zone + side), lss.hazard_distance_cap
    if lss.assessment == "touchdown":
        landable = inside >= radius - 1e-9
        unsafe = touchdown.unsafe(raster, landable)
        unsafe |= landable & grown(touching(bits & np.uint8(hazards.EXCEPTION)) > 0, radius, side)
        unsafe |= landable & grown(unsafe, lss.hazard_growth, side)
        hazard |= unsafe * np.uint8(hazards.TOUCHDOWN)
        # Ground that spoils a landing lies about a radius from the nodes it makes unsafe.
        clearance = Clearance.measure(unsafe, radius, unseen, side, cap)
        safe = ~grown(unsafe, lss.margin, side) & (inside >= zone - 1e-9)
        density_slope = 0.25 * sum_of_corners(slope)
    else:
        clearance = Clearance.measure(hazard > 0, 0.0, unseen, side, cap)
        safe = ~grown(clearance.marked, zone, side) & (inside >= zone - 1e-9)
        density_slope = hazards.slope(cells.normal).take(raster.leaf)
    hazard |= (touching((~raster.seen).view(np.uint8)) > 0) * np.uint8(hazards.UNSEEN)
    over = disc(zone, side)
    rough = np.nan_to_num(cells.roughness).take(raster.leaf)
    score = _score(raster, density_slope, rough, clearance.near, over, lss)
    return NodeAssessment(
        planes, slope, hazard, safe, score, clearance, rough, raster.subscale_peak, over
    )


def _score(
    raster: TerrainRaster,
    slope: Array,
    roughness: Array,
    clearance: Array,
    over: Disc,
    lss: LssConfig,
) -> Array:
    """Eq. 58 on the finest cells; Eq. 56's integral as Eq. 59's mean over the disc of each node.

    The distance to a hazard counts up to ``hazard_distance_cap``.
    """
    density = lss.weight_slope * np.nan_to_num(slope)
    density += lss.weight_roughness * roughness
    density -= (0.25 * lss.weight_hazard_distance) * sum_of_corners(clearance)
    density += lss.weight_subscale * raster.subscale
    return node_means(density, over)


def greatest_in_zones(values: Array, over: Disc, rows: Index, columns: Index) -> Array:
    """Greatest value (K,) of the cells (n, n) in the disc about nodes (K,) inside the domain."""
    last = len(values) - 1
    row = np.clip(rows[:, None] + over.row, 0, last)
    column = np.clip(columns[:, None] + over.column, 0, last)
    out: Array = values[row, column].max(axis=1)
    return out
