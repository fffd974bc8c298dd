# SPDX-License-Identifier: Apache-2.0
"""Planes of higher levels, fused from the leaves below them (paper IV.B, IV.C)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core.geometry import fusion, planes, sphere
from quadtree_lss.core.sensing.register import compact
from quadtree_lss.core.tree.quadtree import CellMap

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class Ancestors:
    """Fused planes of the cells of one level that have a measured leaf below them.

    Attributes:
        level: Their level.
        cell: (A,) iy * 2^level + ix.
        x, y, z: (A,) plane's elevation z above the cell's centre, m.
        normal: (A, 3).
        range_part, pose_part: (A, 3, 3) covariance of (dphi_1, dphi_2, dd), d about (x, y, z).
        of_leaf: (M,) place of each leaf's ancestor, -1 where there is none (the leaf is of a
            higher level, or nothing below the ancestor was measured).
    """

    level: int
    cell: Index
    x: Array
    y: Array
    z: Array
    normal: Array
    range_part: Array
    pose_part: Array
    of_leaf: Index


def fuse_to_level(cells: CellMap, level: int) -> Ancestors:
    """Fuse leaves to their ancestors of ``level`` by Eq. 39-45.

    Each leaf's plane is moved to the ancestor's centre (exactly, value and covariance) and
    observes it. Range noise is independent between leaves, so the range parts weigh and average:
    E = (sum R_i^-1)^-1 sum R_i^-1 E_i. Pose error is shared, so it enters once: the mean of the
    leaves' pose parts, weighted by their measurements. Inherited planes are no information.
    Fusing children of children at once is the same as level by level, information being additive.
    """
    n = 1 << level
    below = cells.level >= level
    down = np.where(below, cells.level.astype(np.int64) - level, 0)
    key = (cells.iy.astype(np.int64) >> down) * n + (cells.ix.astype(np.int64) >> down)
    chosen = np.flatnonzero(below & cells.measured)
    cell, group = compact(key[chosen].astype(np.intp), n * n)
    count = len(cell)
    size = float(cells.domain.cell_size(level))
    x: Array = np.asarray(cells.domain.xmin + (cell % n + 0.5) * size, dtype=np.float64)
    y: Array = np.asarray(cells.domain.ymin + (cell // n + 0.5) * size, dtype=np.float64)
    weight = np.maximum(cells.count[chosen].astype(np.float64), 1.0)
    total = np.bincount(group, weight, minlength=count)
    share = weight / total[group]
    z0 = np.bincount(group, share * cells.z[chosen], minlength=count)
    normal = cells.normal[chosen]
    reference = planes.unit(planes.sum_by(group, count, share[:, None] * normal))
    delta = np.column_stack([x[group], y[group], z0[group]])
    delta -= np.column_stack([cells.x[chosen], cells.y[chosen], cells.z[chosen]])
    d, change = fusion.shift_origin(normal, np.zeros(len(chosen)), delta)
    at = reference[group]
    change = fusion.tangent_change(normal, at) @ change
    range_part = fusion.congruent(change, cells.covariance_range[chosen])
    pose_part = fusion.congruent(change, cells.covariance_pose[chosen])
    error = np.column_stack([sphere.minus(normal, at), d])
    information = planes.inverse_symmetric(range_part)
    pulled = (information @ error[:, :, None])[:, :, 0]
    fused_range = planes.inverse_symmetric(planes.sum_by(group, count, information))
    step = (fused_range @ planes.sum_by(group, count, pulled)[:, :, None])[:, :, 0]
    fused_pose = planes.sum_by(group, count, share[:, None, None] * pose_part)
    fused_normal = planes.upward(sphere.plus(reference, step[:, :2]))
    rise = step[:, 2] / fused_normal[:, 2]
    place = np.full(n * n, -1, dtype=np.intp)
    place[cell] = np.arange(count)
    return Ancestors(
        level=level,
        cell=cell,
        x=x,
        y=y,
        z=z0 + rise,
        normal=fused_normal,
        range_part=fusion.move_up(fused_normal, fusion.sound(fused_range), rise),
        pose_part=fusion.move_up(fused_normal, fusion.sound(fused_pose), rise),
        of_leaf=np.where(below, place[np.where(below, key, 0)], -1),
    )
