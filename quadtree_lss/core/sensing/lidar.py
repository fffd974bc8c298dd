# SPDX-License-Identifier: Apache-2.0
"""Lidar measurements: from ranges to points in the map frame with their covariance (paper III.C).

Lidar axes are Eq. 14's: z boresight, x right, y down (ROS calls such a frame ``_optical``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from quadtree_lss.core.geometry.rotations import skew

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: One in so many pixels tells a scan's usual distance between neighbours.
SAMPLED = 7
#: So many cubes are counted in a table; where there are more, points are sorted by theirs.
MAX_CUBES = 1 << 22


@dataclass(frozen=True)
class Pose:
    """Estimated lidar pose at one instant.

    Attributes:
        stamp_ns: Time in integer nanoseconds.
        position: (3,) lidar origin in the map frame, m.
        rotation_map_lidar: (3, 3) takes lidar axes to map axes.
        covariance: (6, 6) of (x, y, z, rotation about the map's fixed X, Y, Z), m and rad,
            as in ``geometry_msgs/PoseWithCovariance``.
    """

    stamp_ns: int
    position: Array
    rotation_map_lidar: Array
    covariance: Array


def points_from_ranges(ranges: ArrayLike, azimuth: ArrayLike, elevation: ArrayLike) -> Array:
    """Eq. 14: ranges in m and angles in rad, each (...), to points (..., 3) in lidar axes."""
    rho = np.asarray(ranges, dtype=np.float64)
    cos_el = np.cos(elevation)
    return np.stack(
        [
            rho * np.sin(azimuth) * cos_el,
            -rho * np.sin(elevation),
            rho * np.cos(azimuth) * cos_el,
        ],
        axis=-1,
    )


def fixed_from_body_covariance(
    sigma_position: Array, sigma_rotation: Array, rotation: Array
) -> Array:
    """Fixed-axis 6x6 covariance of a pose perturbed as in Eq. 16.

    Eq. 16 perturbs on the right, in lidar axes: R_hat = R exp(dR). About the map's axes the same
    error is R dR, so Sigma_fixed = R Sigma_R R^T.

    Args:
        sigma_position: (3, 3) position covariance, map axes, m^2.
        sigma_rotation: (3, 3) covariance of dR in lidar axes, rad^2.
        rotation: (3, 3) rotation_map_lidar.
    """
    out = np.zeros((6, 6))
    out[:3, :3] = sigma_position
    out[3:, 3:] = rotation @ sigma_rotation @ rotation.T
    return out


def body_from_fixed_covariance(covariance: Array, rotation: Array) -> Array:
    """Inverse of the above with the cross block: Sigma_R = R^T Sigma_fixed R, Sigma_m,fixed R."""
    t = np.eye(6)
    t[3:, 3:] = rotation.T
    return t @ covariance @ t.T


def point_covariances(points_map: Array, pose: Pose, range_noise: float) -> Array:
    """Eq. 17: covariance (N, 3, 3) in m^2 of points (N, 3) in map axes.

    With the pose error (dm, dw) about fixed axes, dr = dm + dw x (r - m), and the range error
    moves the point along its ray u: Sigma_r = J Sigma_pose J^T + sigma^2 u u^T with
    J = [I, -[r - m]_x].
    """
    arm = points_map - pose.position
    jacobian = np.concatenate([np.broadcast_to(np.eye(3), (len(arm), 3, 3)), -skew(arm)], axis=-1)
    ray = arm / np.linalg.norm(arm, axis=-1, keepdims=True)
    along = range_noise**2 * ray[:, :, None] * ray[:, None, :]
    out: Array = jacobian @ pose.covariance @ jacobian.transpose(0, 2, 1) + along
    return out


def isolated_returns(points: Array, valid: Mask, ranges: Array, gate: float) -> Mask:
    """Returns without a neighbour: noise, multipath, dust.

    In an organised scan the neighbours are the four next to a pixel and the distance is the
    difference in range; otherwise the neighbour is the nearest point in space. The gate widens to
    five times the scan's median neighbour distance, which is what a coarse view of slanted
    ground needs.

    Args:
        points: (3, N) in any axes, m; N = H W, row by row, of an organised scan.
        valid: (H, W) or (N,), True where there is a return.
        ranges: like ``valid``, m.
        gate: Distance in m, 0 keeps every return.

    Returns:
        Mask like ``valid``, True at isolated returns.
    """
    if gate <= 0.0 or np.count_nonzero(valid) < 2:
        return np.zeros(valid.shape, dtype=np.bool_)
    if valid.ndim == 1:
        out = np.zeros(valid.shape, dtype=np.bool_)
        out[valid] = _alone(points[:, valid] if not valid.all() else points, gate)
        return out
    distance = _nearest_in_range(ranges, valid)
    lonely = valid & (distance > gate)
    if not lonely.any():
        return lonely
    usual = float(np.median(distance[valid][::SAMPLED]))
    return lonely & (distance > 5.0 * usual) if np.isfinite(usual) else lonely


def _alone(points: Array, gate: float) -> Mask:
    """Points (3, N) farther from any other than the gate, widened as in ``isolated_returns``.

    Most points share a cube with another whose diagonal is the gate, in one grid of cubes or in
    a second one half a side away; only the others look for their nearest neighbour.
    """
    limit = max(gate, 5.0 * _usual_spacing(points))
    alone = _alone_in_cube(points, limit / 1.7321, 0.0)
    if len(alone):
        alone = np.intersect1d(alone, _alone_in_cube(points, limit / 1.7321, 0.5))
    out = np.zeros(points.shape[1], dtype=np.bool_)
    if len(alone):
        near = points[:, _around(points, alone, limit)].T
        tree = cKDTree(near, balanced_tree=False, compact_nodes=False)
        reach = 1.001 * limit
        distance, _ = tree.query(points[:, alone].T, k=2, distance_upper_bound=reach)
        out[alone] = np.asarray(distance)[:, 1] > limit
    return out


def _alone_in_cube(points: Array, side: float, shift: float) -> NDArray[np.intp]:
    """Which points (3, N) share their cube with no other; cubes start ``shift`` sides off."""
    low = points.min(axis=1)
    spans = [int(span) + 2 for span in (points.max(axis=1) - low) / side]
    cubes = spans[0] * spans[1] * spans[2]
    if cubes >= 1 << 62:
        return np.arange(points.shape[1])
    key = np.zeros(points.shape[1], dtype=np.int64)
    for axis, span in enumerate(spans):
        key *= span
        key += ((points[axis] - low[axis]) / side + shift).astype(np.int64)
    if cubes <= MAX_CUBES:
        return np.flatnonzero(np.bincount(key)[key] == 1)
    order = np.argsort(key)
    ordered = key[order]
    differs = np.concatenate([[True], ordered[1:] != ordered[:-1], [True]])
    alone: NDArray[np.intp] = order[differs[1:] & differs[:-1]]
    return alone


def _around(points: Array, chosen: NDArray[np.intp], reach: float) -> NDArray[np.intp]:
    """Points (3, N) that may lie within ``reach`` of a chosen one: those in columns next to its."""
    low = points[:2].min(axis=1)
    if float(np.ptp(points[:2], axis=1).max()) / reach > 8192.0:
        return np.arange(points.shape[1])
    column = ((points[0] - low[0]) / reach).astype(np.intp)
    row = ((points[1] - low[1]) / reach).astype(np.intp)
    mark = np.zeros((int(column.max()) + 3, int(row.max()) + 3), dtype=np.bool_)
    for dx in (0, 1, 2):
        for dy in (0, 1, 2):
            mark[column[chosen] + dx, row[chosen] + dy] = True
    return np.flatnonzero(mark[column + 1, row + 1])


def _usual_spacing(points: Array) -> float:
    """Median distance of nearest neighbours in (3, N), from one in k of a large cloud's points.

    Ground is a surface, so a sample of one in k lies sqrt(k) times as far apart. Steps of the
    golden section take it from all over the cloud, whatever raster that is in.
    """
    count = points.shape[1]
    share = max(count / 4096.0, 1.0)
    sample = points.T
    if share > 1.0:
        sample = points[:, (np.arange(4096) * 0.6180339887498949 % 1.0 * count).astype(np.intp)].T
    near = np.asarray(cKDTree(sample).query(sample, k=2)[0])[:, 1]
    return float(np.median(near)) / float(np.sqrt(share))


def _nearest_in_range(ranges: Array, valid: Mask) -> Array:
    """Least absolute range difference of each pixel (H, W) to the four next to it."""
    known = np.where(valid, ranges, np.nan)
    nearest = np.full(valid.shape, np.inf)
    for first, second in (
        ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
        ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
    ):
        difference = np.abs(known[second] - known[first])
        np.fmin(nearest[first], difference, out=nearest[first])
        np.fmin(nearest[second], difference, out=nearest[second])
    return nearest
