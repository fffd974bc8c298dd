# SPDX-License-Identifier: Apache-2.0
"""Scans brought to where the map is: the offset between both, filtered from scan to scan.

Navigation errs by centimetres to decimetres that persist over many scans and differ from flight
to flight. A cell seen by other scans than its neighbour would average other errors: level ground
would come out in steps, a rock seen in two flights would be two. Eq. 20 gives each scan of a cell
its own offset gamma_j; here the offset is the scan's, common to all of its cells.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core.config import MappingConfig
from quadtree_lss.core.lidar import Pose

Array = NDArray[np.float64]

#: A cell that departs from the others by more than this many deviations counts less.
HUBER = 2.0
#: Variance of a cell's height from what no covariance tells (ground that planes smooth), m^2.
MODEL_VARIANCE = 0.02**2
#: Deviation of a measured offset (x, y, z) that more cells do not make smaller, m.
FLOOR = np.array([0.05, 0.05, 0.02])
#: Deviation by which the offset wanders from one scan to the next, m.
DRIFT = 0.001
#: A scan whose offset departs by more than this many deviations has jumped.
JUMP = 4.0
#: Cells seen before that a scan needs to be moved.
MIN_CELLS = 3


class ScanAlignment:
    """Offset b (3,) of the scans from the map, m: a filter that knows slow drift and jumps.

    Ground that lies b off has, over a cell of slopes (p, q), the height b_z - p b_x - q b_y over
    the map's. All cells seen before together measure b by weighted least squares; with covariance
    P of b and R of the measurement, K = P (P + R)^-1, b += K (measured - b). Drift adds to P scan
    by scan. After a jump (another flight, a position fix, errors that are independent from scan to
    scan) P is what the navigation says itself, and the next scans decide whether b persists: only
    then is a scan moved by it before it is binned. The height is taken out at once.

    The map cannot move sideways; in height it meets the scan after a jump, each by its share of
    the variance.

    Attributes:
        offset: b (3,), m.
        covariance: P (3, 3), m^2.
        persists: Whether the last scan confirmed b.
        map_variance: Variance of the map's common height, m^2; NaN before the first scan.
    """

    def __init__(self, config: MappingConfig) -> None:
        self.enabled = config.align
        self.reset()

    def reset(self) -> None:
        """Before the first scan."""
        self.offset = np.zeros(3)
        self.covariance = np.zeros((3, 3))
        self.persists = False
        self.map_variance = np.nan
        self._applied = np.zeros(3)

    def export_state(self) -> dict[str, NDArray[Any]]:
        """All of it by name."""
        return {
            "offset": self.offset.copy(),
            "covariance": self.covariance.copy(),
            "persists": np.array(self.persists),
            "map_variance": np.array(self.map_variance),
        }

    def import_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from `export_state`."""
        self.reset()
        self.offset, self.covariance = state["offset"].copy(), state["covariance"].copy()
        self.persists, self.map_variance = bool(state["persists"]), float(state["map_variance"])

    def predicted(self, pose: Pose) -> Pose:
        """The pose that takes a scan to where the last ones say that the map is."""
        self._applied = self.offset if self.enabled and self.persists else np.zeros(3)
        if not self._applied.any():
            return pose
        moved = pose.position - self._applied
        return Pose(pose.stamp_ns, moved, pose.rotation_map_lidar, pose.covariance)

    def meet(
        self, rise: Array, variance: Array, normal: Array, scan_covariance: Array
    ) -> tuple[float, float]:
        """Learn from one scan; how far it goes down still and the map goes up, m.

        Args:
            rise: (M,) height of the scan's planes over the map's in cells seen before, m.
            variance: (M,) of each from what is not common to the scan, m^2.
            normal: (M, 3) of the map's planes.
            scan_covariance: (3, 3) that the pose error gives the place of the scan's ground, m^2.
        """
        if np.isnan(self.map_variance):
            self.map_variance = float(scan_covariance[2, 2])
            return 0.0, 0.0
        if not self.enabled or len(rise) < MIN_CELLS:
            return 0.0, 0.0
        left, noise = measured_offset(rise, variance + MODEL_VARIANCE, normal)
        noise += np.diag(FLOOR**2)
        innovation = self._applied + left - self.offset
        drift = np.minimum(DRIFT**2, np.diag(scan_covariance))
        self.covariance = self.covariance + np.diag(drift)
        spread = self.covariance + noise
        jumped = innovation @ np.linalg.solve(spread, innovation) > JUMP**2
        self.persists = not jumped
        lift_share = 0.0
        if jumped:
            self.covariance = 2.0 * scan_covariance
            self.covariance[2, 2] += self.map_variance - scan_covariance[2, 2]
            spread = self.covariance + noise
            total = self.map_variance + float(scan_covariance[2, 2])
            lift_share = self.map_variance / total if total > 0.0 else 0.0
            self.map_variance *= 1.0 - self.map_variance / float(spread[2, 2])
        gain = np.linalg.solve(spread, self.covariance).T
        self.offset = self.offset + gain @ innovation
        self.covariance = (np.eye(3) - gain) @ self.covariance
        lift = float(self.offset[2]) * lift_share
        self.offset[2] -= lift
        return float(self.offset[2] - self._applied[2]), lift


def measured_offset(rise: Array, variance: Array, normal: Array) -> tuple[Array, Array]:
    """Weighted least squares offset (3,), m, and its covariance (3, 3).

    A p-q design from the normals: rise = b_z + (n_x b_x + n_y b_y) / n_z. Cells far from the
    median count less; what the slopes do not show stays near zero with a large variance.

    Args:
        rise, variance: (M,) m, m^2.
        normal: (M, 3) of the map's planes.
    """
    weight = 1.0 / variance
    order = np.argsort(rise)
    half = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
    away = np.abs(rise - rise[order[half]]) * np.sqrt(weight)
    weight *= np.minimum(1.0, HUBER / np.maximum(away, HUBER))
    design = normal / normal[:, 2:]
    information = (design * weight[:, None]).T @ design + 1e-6 * np.eye(3)
    covariance: Array = np.linalg.inv(information).astype(np.float64)
    offset: Array = covariance @ (design.T @ (weight * rise))
    return offset, covariance
