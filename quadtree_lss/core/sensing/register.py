# SPDX-License-Identifier: Apache-2.0
"""One scan on its way into the map: validated, taken to the map frame, binned (paper IV.A)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.config.settings import LidarConfig
from quadtree_lss.core.geometry.planes import covariance_root
from quadtree_lss.core.sensing.lidar import Pose, isolated_returns
from quadtree_lss.core.tree.quadtree import Domain

Array = NDArray[np.float64]
Index = NDArray[np.intp]

#: So many points from different parts of the scan follow one another.
LANES = 8


@dataclass(frozen=True)
class RegisteredScan:
    """Points of one scan inside the domain.

    Attributes:
        pose: Lidar pose, its covariance positive semidefinite and bounded.
        pose_root: (6, 6) root of the pose covariance.
        points: (3, N) map frame, m.
        finest: (N,) index iy * n + ix of the finest cell under each point.
        centre: x and y of the middle of the sound returns, those outside the domain included,
            map frame, m; None if there is none.
    """

    pose: Pose
    pose_root: Array
    points: Array
    finest: Index
    centre: tuple[float, float] | None


def register(
    points_lidar: Array, pose: Pose, lidar: LidarConfig, domain: Domain
) -> tuple[RegisteredScan, dict[str, int]]:
    """Keep the sound returns, apply Eq. 15 and find each one's finest cell.

    Args:
        points_lidar: (H, W, 3) organised or (N, 3), lidar axes, m; not finite = no return.

    Returns:
        The scan and how many points were dropped, by reason: ``no_return``, ``range``,
        ``isolated``, ``outside`` (of the domain).
    """
    shape = points_lidar.shape[:-1]
    flat = points_lidar.reshape(-1, 3)
    with np.errstate(invalid="ignore", over="ignore"):
        points = pose.rotation_map_lidar @ flat.T
        ranges = np.sqrt(points[0] * points[0] + points[1] * points[1] + points[2] * points[2])
        finite = np.isfinite(ranges)
        valid = finite & (ranges > 0.0) & (ranges >= lidar.min_range) & (ranges <= lidar.max_range)
    returns = int(np.count_nonzero(finite))
    in_range = int(np.count_nonzero(valid))
    if in_range:
        lonely = isolated_returns(
            points, valid.reshape(shape), ranges.reshape(shape), lidar.outlier_gate
        )
        valid &= ~lonely.ravel()
    kept = int(np.count_nonzero(valid))
    if kept < len(flat):
        points = points.take(np.flatnonzero(valid), axis=1)
    points += pose.position[:, None]
    centre = (float(points[0].mean()), float(points[1].mean())) if kept else None
    n = domain.finest_count
    scale = 1.0 / domain.finest_size
    column = np.floor((points[0] - domain.xmin) * scale)
    row = np.floor((points[1] - domain.ymin) * scale)
    inside = (column >= 0) & (column < n) & (row >= 0) & (row < n)
    within = _apart(np.flatnonzero(inside))
    points, column, row = points.take(within, axis=1), column[within], row[within]
    finest = (row * n + column).astype(np.intp)
    dropped = {
        "no_return": len(valid) - returns,
        "range": returns - in_range,
        "isolated": in_range - kept,
        "outside": kept - len(finest),
    }
    root = covariance_root(pose.covariance)
    pose = replace(pose, covariance=root @ root.T)
    scan = RegisteredScan(pose, root, points, finest, centre)
    return scan, dropped


def _apart(index: Index) -> Index:
    """The same indices (N,) in an order that takes neighbours apart.

    Sums over cells wait for the last addition to the same cell: neighbours in a row of pixels,
    which mostly share theirs, take half as long again as points far apart.
    """
    rows = len(index) // LANES
    return np.concatenate(
        [index[: rows * LANES].reshape(LANES, rows).T.ravel(), index[rows * LANES :]]
    )


def compact(values: Index, bound: int) -> tuple[Index, Index]:
    """Distinct values, ascending, and the place of each value among them, without sorting.

    Args:
        values: (N,) in 0 .. bound - 1.
    """
    mark = np.zeros(bound, dtype=np.bool_)
    mark[values] = True
    distinct = np.flatnonzero(mark)
    place = np.empty(bound, dtype=np.intp)
    place[distinct] = np.arange(len(distinct))
    return distinct, place[values]
