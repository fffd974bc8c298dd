# SPDX-License-Identifier: Apache-2.0
"""Registration of a scan: validation, rotation to map axes, Morton order (paper IV.A)."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from quadtree_lss.onboard.arrays import Array, Index, Keys, Points
from quadtree_lss.onboard.config.settings import LidarConfig
from quadtree_lss.onboard.core.geometry.bounds import MAX_HEIGHT
from quadtree_lss.onboard.core.geometry.morton import SPREAD
from quadtree_lss.onboard.core.sensing.isolated import isolated_in_image, isolated_in_space
from quadtree_lss.onboard.core.sensing.lidar import Pose, clip_covariance
from quadtree_lss.onboard.core.sensing.points import Workspace, sort_points, transform_points
from quadtree_lss.onboard.core.sensing.sweep import NO_OFFSETS, STAMP_ONLY, Sweep

if TYPE_CHECKING:
    from quadtree_lss.onboard.core.tree.domain import Domain
    from quadtree_lss.onboard.core.tree.held_returns import HeldReturns, IsolatedReturns

#: Reasons for dropping all points: most lie above the lidar; the scan contradicts the map.
ABOVE, CONTRADICTION = "above", "contradiction"
#: Greatest height of a lidar, m: ranges are at most 1e6 m, and map heights less than `MAX_HEIGHT`.
HIGHEST = MAX_HEIGHT - 2e6


class RegisteredScan(NamedTuple):
    """Points of one scan inside the domain, in Morton order of the finest cells under them.

    Attributes:
        pose: Lidar pose at the scan's stamp, its covariance positive semidefinite and bounded.
        points: (N, 3) map axes about the pose's position, m. They are also the rays, because the
            motion of the lidar during the scan is far shorter.
        key: (N,) Morton code of the finest cell of each point, ascending; points of a cell keep the
            order of the scan.
        centre: x and y of the mean valid return, map frame, m, if all are outside the domain.
        isolated: Isolated returns, compared with those held back; None if there are none.
        admitted: Number of points that are held-back returns of earlier scans.
    """

    pose: Pose
    points: Array
    key: Keys
    centre: tuple[float, float] | None
    isolated: IsolatedReturns | None = None
    admitted: int = 0


def register(
    points_lidar: Points,
    pose: Pose,
    lidar: LidarConfig,
    domain: Domain,
    sweep: Sweep | None = None,
    held: HeldReturns | None = None,
    work: Workspace | None = None,
) -> tuple[RegisteredScan, dict[str, int]]:
    """Drop invalid returns, apply Eq. 15 and sort the points by cell.

    Arguments as of `Mapper.update`; ``held``: isolated returns of earlier scans, of which those
    that this scan confirms are added to it (without it, all isolated returns are dropped);
    ``work``: reused memory. Return also the number of dropped points by reason: ``no_return``,
    ``range``, ``isolated``, ``outside`` (of the domain) and ``above``: if more than half of the
    rest lies above the lidar, the pose has other axes, and the rest is dropped.

    Raises `ValueError`: the sweep has another number of points.
    """
    flat = points_lidar.reshape(-1, 3)
    if flat.dtype not in (np.float32, np.float64):
        flat = flat.astype(np.float64)
    if sweep is not None and len(sweep.offsets) != len(flat):
        raise ValueError(f"sweep of {len(sweep.offsets)} points for a scan of {len(flat)}")
    work = work or Workspace()
    work.resize(len(flat))
    if sweep is None:
        sweep = Sweep(NO_OFFSETS, STAMP_ONLY, np.zeros((1, 12)))
        sweep.motion[0, :9] = pose.rotation_map_lidar.ravel()
    motion = sweep.offsets, sweep.times, sweep.motion
    transform_points(flat, *motion, lidar, domain, pose.position, work)
    points_map, ranges = np.asarray(work.points)[: len(flat)], np.asarray(work.ranges)
    if points_lidar.ndim == 3:
        isolated = isolated_in_image(ranges.reshape(points_lidar.shape[:2]), lidar.outlier_gate)
    else:
        isolated = isolated_in_space(points_map, ranges, lidar.outlier_gate)
    compared = None
    if held is not None and len(isolated):
        compared = held.compare(points_map[isolated] + pose.position, domain, lidar.outlier_gate)
        isolated = isolated[~compared.confirmed]
    ranges[isolated] = np.nan
    valid = len(flat) - work.missing - work.beyond - len(isolated)
    n = 1 << domain.max_level
    points, key = sort_points(work, len(isolated) > 0, n * n)
    if abs(pose.position[2]) >= HIGHEST:
        points, key = points[:0], key[:0]
    inside = len(key)
    centre = None
    if valid and not inside:
        mean = points_map[ranges > 0.0, :2].mean(axis=0) + pose.position[:2]
        centre = float(mean[0]), float(mean[1])
    above = np.count_nonzero(points[:, 2] > 0.0) if work.above else 0
    above = inside if 2 * above > inside else 0
    points, key, admitted = points[: inside - above], key[: inside - above], 0
    if held is not None and compared is not None and len(compared.admitted) and len(key):
        positions = held.places(compared.admitted, domain)
        points, key = _insert_admitted(points, key, positions - pose.position, compared.admitted, n)
        admitted = len(positions)
    bounded = replace(pose, covariance=clip_covariance(pose.covariance))
    scan = RegisteredScan(bounded, points, key, centre, compared, admitted)
    dropped = {
        "no_return": work.missing,
        "range": work.beyond,
        "isolated": len(isolated),
        "outside": valid - inside,
    }
    return scan, dropped | ({ABOVE: above} if above else {})


def _insert_admitted(
    points: Array, key: Keys, admitted: Array, cells: Index, n: int
) -> tuple[Array, Keys]:
    """Insert ``admitted`` points (A, 3) after the points (N, 3) of their cells, and their keys.
    ``cells``: (A,) index iy * n + ix of their cells."""
    iy, ix = np.divmod(cells, n)
    own = SPREAD[ix] | SPREAD[iy] << 1
    order = np.argsort(own)
    index = np.searchsorted(key, own[order], side="right")
    return np.insert(points, index, admitted[order], axis=0), np.insert(key, index, own[order])
