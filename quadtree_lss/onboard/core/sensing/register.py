# SPDX-License-Identifier: Apache-2.0
"""One scan on its way into the map: validated, taken to map axes, in Morton order (paper IV.A)."""

from __future__ import annotations

import threading
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

#: Of larger scans no memory is kept.
KEPT_POINTS = 1 << 20
#: What a lidar higher or lower than this sees is beyond the heights of maps, m: rays end at 1e6.
HIGHEST = MAX_HEIGHT - 2e6


class RegisteredScan(NamedTuple):
    """Points of one scan inside the domain, in Morton order of the finest cells under them.

    Attributes:
        pose: Lidar pose at the scan's stamp, its covariance positive semidefinite and bounded.
        origin: (3,) position of the lidar at the scan's stamp, map frame, m.
        points: (N, 3) map axes about ``origin``, m: each point is its own ray (but for the
            lidar's way between the stamp and the point's time, far shorter than a ray).
        key: (N,) Morton code of the finest cell under each point, ascending; points of a cell
            keep the order of the scan.
        centre: x and y of the middle of the sound returns, map frame, m, if all of them are outside
            the domain; otherwise, or if there is none, None.
        isolated: Isolated returns, compared with those held back; None if there is none, or if
            none are held back.
        admitted: How many of the points are held-back returns of earlier scans.
    """

    pose: Pose
    origin: Array
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
) -> tuple[RegisteredScan, dict[str, int]]:
    """Keep the sound returns, apply Eq. 15 and bring them into the order of the cells.

    Args:
        points_lidar: (H, W, 3) organised or (N, 3), float32 or float64, lidar axes, m; not
            finite = no return.
        pose: Of the lidar at the scan's stamp.
        sweep: How the lidar moved while it took the scan, if it did; of as many points.
        held: Isolated returns of earlier scans. Those that this one confirms enter with it;
            without it, all isolated returns are dropped.

    Returns:
        The scan and how many points were dropped, by reason: ``no_return``, ``range``,
        ``isolated``, ``outside`` (of the domain); ``above`` are all others of a scan most of which
        lies above the lidar: no ground does, so its pose is of other axes.
    """
    flat = points_lidar.reshape(-1, 3)
    if flat.dtype not in (np.float32, np.float64):
        flat = flat.astype(np.float64)
    if sweep is not None and len(sweep.offsets) != len(flat):
        msg = f"sweep of {len(sweep.offsets)} points for a scan of {len(flat)}"
        raise ValueError(msg)
    work = _workspace(len(flat))
    points_map = work.points_map[: len(flat)]
    if sweep is None:
        work.still[0, :9] = pose.rotation_map_lidar.ravel()
        motion = NO_OFFSETS, STAMP_ONLY, work.still
    else:
        motion = sweep.offsets, sweep.times, sweep.motion
    x, y, z = pose.position.tolist()
    n = 1 << domain.max_level
    transform_points(
        flat,
        *motion,
        lidar.min_range,
        lidar.max_range,
        x - domain.xmin,
        y - domain.ymin,
        n / domain.size,
        n,
        work,
    )
    if points_lidar.ndim == 3:
        image = work.ranges.reshape(points_lidar.shape[:2])
        alone = isolated_in_image(image, lidar.outlier_gate)
    else:
        alone = isolated_in_space(points_map, work.ranges, lidar.outlier_gate)
    compared = None
    if held is not None and len(alone):
        compared = held.compare(points_map[alone] + pose.position, domain, lidar.outlier_gate)
        alone = alone[~compared.confirmed]
    work.ranges[alone] = np.nan
    isolated = len(alone)
    sound = len(flat) - work.missing - work.beyond - isolated
    points, key = work.output()
    inside = sort_points(work, isolated > 0, n * n) if abs(z) < HIGHEST else 0
    middle = None
    if sound and not inside:
        middle = (points_map[work.ranges > 0.0, :2].mean(axis=0) + pose.position[:2]).tolist()
    above = int(np.count_nonzero(points[:inside, 2] > 0.0)) if work.above else 0
    above = inside if 2 * above > inside else 0
    points, key, admitted = points[: inside - above], key[: inside - above], 0
    if held is not None and compared is not None and len(compared.admitted) and len(key):
        places = held.places(compared.admitted, domain)
        points, key = _with_held(points, key, places - pose.position, compared.admitted, n)
        admitted = len(places)
    scan = RegisteredScan(
        pose=Pose(
            pose.stamp_ns, pose.position, pose.rotation_map_lidar, clip_covariance(pose.covariance)
        ),
        origin=pose.position,
        points=points,
        key=key,
        centre=None if middle is None else (middle[0], middle[1]),
        isolated=compared,
        admitted=admitted,
    )
    dropped = {
        "no_return": work.missing,
        "range": work.beyond,
        "isolated": isolated,
        "outside": sound - inside,
    }
    return scan, dropped | ({"above": above} if above else {})


def _with_held(points: Array, key: Keys, places: Array, cells: Index, n: int) -> tuple[Array, Keys]:
    """Points (N, 3) and their ascending keys (N,) with ``places`` (A, 3), each after the points of
    its cell. ``cells``: (A,) of the places, iy * n + ix."""
    iy, ix = np.divmod(cells, n)
    own = SPREAD[ix] | SPREAD[iy] << 1
    order = np.argsort(own)
    at = np.searchsorted(key, own[order], side="right")
    return np.insert(points, at, places[order], axis=0), np.insert(key, at, own[order])


def _workspace(size: int) -> Workspace:
    """Kept for the next scan of this size: fresh memory costs as much as the work in it."""
    if size > KEPT_POINTS:
        return Workspace(size)
    if getattr(_kept, "size", None) != size:
        _kept.size, _kept.work = size, Workspace(size)
    work: Workspace = _kept.work
    return work


_kept = threading.local()
