# SPDX-License-Identifier: Apache-2.0
"""Scans brought to where the map is: the offset between both, filtered from scan to scan.

Navigation errs by centimetres to decimetres that persist over many scans and differ from flight
to flight. A cell seen by other scans than its neighbour would average other errors: level ground
would come out in steps, a rock seen in two flights would be two. Eq. 20 gives each scan of a cell
its own offset gamma_j; here the offset is the scan's, common to all of its cells.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.config.settings import MappingConfig
from quadtree_lss.core.sensing.lidar import Pose

Array = NDArray[np.float64]

#: A cell that departs from the others by more than this many deviations counts less.
HUBER = 2.0
#: Variance of a cell's height from what no covariance tells (ground that planes smooth), m^2.
MODEL_VARIANCE = 0.02**2
#: Deviation of a measured offset (x, y, z) that more cells do not make smaller, m.
FLOOR = np.array([0.05, 0.05, 0.04])
#: Time over which a navigation error that persists is forgotten, s.
PERSISTENCE_TIME = 300.0
#: Deviation by which the map's own error may wander from one scan to the next, m.
DRIFT = 0.001
#: An offset of more than this many deviations refutes the covariance that the pose claims.
REFUTED = 4.0
#: Of the share of scans whose error is the last one's, each scan renews this part.
RENEWAL = 0.3
#: The share stays this far from none and from all, so that a change is still noticed.
DOUBT = 0.02
#: A scan's error sideways is at most this many deviations of what its pose claims.
SIDEWAYS = 3.0
#: Where the map's error stands in the state.
OF_MAP = np.arange(3, 6)
#: Cells seen before that a scan needs to be moved.
MIN_CELLS = 3


class ScanAlignment:
    """Kalman filter of a scan's navigation error n (3,) and of the map's own error m (3,), m.

    Where scan and map overlap, ground that lies b = n - m off has, over a cell of slopes (p, q),
    the height b_z - p b_x - q b_y over the map's. All cells seen before together measure b by
    weighted least squares with covariance R. The first scan makes the map: n = m, each of the
    pose's covariance S. From then on one of two things happened before each scan:

    - the error persisted: n <- a n, P_nn <- a^2 P_nn + (1 - a^2) S, a = exp(-dt / time), so that
      it stays within what the pose claims;
    - it is another one (another flight, a position fix, errors that are independent from scan to
      scan): n = 0, P_nn = S, P_nm = 0.

    Either state is updated with K = P H^T (H P H^T + R)^-1, H = (I, -I), and both are merged with
    weights from the likelihoods of the measured offset and from how often errors persisted so far.
    Before it is binned a scan is moved by what is expected of b, afterwards, in height, by what
    was learnt. The map cannot move sideways; in height it does as soon as its error is known to be
    more than half its deviation.

    Attributes:
        mean: (6,) n, m, m.
        covariance: P (6, 6), m^2.
        persistence: Share of scans whose error was that of the scan before, 0 .. 1.
    """

    def __init__(self, config: MappingConfig) -> None:
        self.enabled = config.align
        self.reset()

    def reset(self) -> None:
        """Before the first scan."""
        self.mean = np.zeros(6)
        self.covariance = np.full((6, 6), np.nan)
        self.persistence = 1.0 - DOUBT
        self._stamp_ns = 0
        self._now_ns = 0
        self._applied = np.zeros(3)

    @property
    def started(self) -> bool:
        """Whether there is a map to align to."""
        return not math.isnan(self.covariance[0, 0])

    @property
    def offset(self) -> tuple[float, float, float]:
        """By how much the last scan's ground lay off the map's, b = n - m; 0 if not aligned, m."""
        if not self.enabled:
            return 0.0, 0.0, 0.0
        x, y, z = (self.mean[:3] - self.mean[3:]).tolist()
        return x, y, z

    @property
    def height_variance(self) -> float:
        """Variance of the map's common height, m^2; 0 if scans are not aligned."""
        if not (self.enabled and self.started):
            return 0.0
        return float(self.covariance[5, 5] + self.mean[5] ** 2)

    def export_state(self) -> dict[str, NDArray[Any]]:
        """All of it by name."""
        return {
            "mean": self.mean.copy(),
            "covariance": self.covariance.copy(),
            "persistence": np.array(self.persistence),
            "stamp_ns": np.array(self._stamp_ns),
        }

    def import_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from `export_state`."""
        self.reset()
        self.mean, self.covariance = state["mean"].copy(), state["covariance"].copy()
        self.persistence = float(state["persistence"])
        self._stamp_ns = int(state["stamp_ns"])

    def predicted(self, pose: Pose) -> Pose:
        """The pose that takes a scan to where the last ones say that the map is."""
        self._now_ns = pose.stamp_ns
        self._applied = np.zeros(3)
        if not (self.enabled and self.started):
            return pose
        self._applied = self.persistence * (self._decay() * self.mean[:3] - self.mean[3:])
        moved = pose.position - self._applied
        return Pose(pose.stamp_ns, moved, pose.rotation_map_lidar, pose.covariance)

    def _decay(self) -> float:
        seconds = abs(self._now_ns - self._stamp_ns) * 1e-9
        return math.exp(-seconds / PERSISTENCE_TIME)

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
        if not self.started:
            self.covariance = np.tile(scan_covariance, (2, 2))
            self._stamp_ns = self._now_ns
            return 0.0, 0.0
        if not self.enabled:
            return 0.0, 0.0
        mean, covariance = self._predict(scan_covariance)
        self._stamp_ns = self._now_ns
        if len(rise) < MIN_CELLS:
            self._merge(mean, covariance, self.persistence)
            return 0.0, 0.0
        left, noise = measured_offset(rise, variance + MODEL_VARIANCE, normal)
        noise.flat[::4] += FLOOR**2
        self._update(mean, covariance, self._applied + left, noise)
        reach = SIDEWAYS * np.sqrt(scan_covariance.diagonal()[:2])
        self.mean[:2] = np.minimum(np.maximum(self.mean[:2], -reach), reach)
        return self._move()

    def _predict(self, scan_covariance: Array) -> tuple[Array, Array]:
        """Means (2, 6) and covariances (2, 6, 6): the error persisted, it is another one."""
        decay = self._decay()
        mean, covariance = np.empty((2, 6)), np.empty((2, 6, 6))
        mean[:], covariance[:] = self.mean, self.covariance
        mean[0, :3] *= decay
        mean[1, :3] = 0.0
        covariance[0, :3] *= decay
        covariance[0, :, :3] *= decay
        covariance[0, :3, :3] += (1.0 - decay**2) * scan_covariance
        covariance[1, :3] = covariance[1, :, :3] = 0.0
        covariance[1, :3, :3] = scan_covariance
        covariance[:, OF_MAP, OF_MAP] += np.minimum(DRIFT**2, scan_covariance.diagonal())
        return mean, covariance

    def _update(self, mean: Array, covariance: Array, measured: Array, noise: Array) -> None:
        """Measurement of b = n - m by both hypotheses, merged into one."""
        innovation = (measured - (mean[:, :3] - mean[:, 3:]))[:, :, None]
        cross, spread, inverse, square = _spread(covariance, noise, innovation)
        if min(square) > REFUTED**2:
            covariance[1, :3, :3] *= 1.0 + square[1] / 3.0
            cross, spread, inverse, square = _spread(covariance, noise, innovation)
        gain = cross @ inverse
        mean += (gain @ innovation)[:, :, 0]
        covariance -= gain @ cross.transpose(0, 2, 1)
        size = np.linalg.det(spread).tolist()
        ratio = 0.5 * (square[0] - square[1]) + 0.5 * math.log(size[0] / size[1])
        odds = (1.0 - self.persistence) / self.persistence * math.exp(min(ratio, 500.0))
        persisted = 1.0 / (1.0 + odds)
        self._merge(mean, covariance, persisted)
        renewed = self.persistence + RENEWAL * (persisted - self.persistence)
        self.persistence = min(max(renewed, DOUBT), 1.0 - DOUBT)

    def _merge(self, mean: Array, covariance: Array, persisted: float) -> None:
        """Mean and covariance of the mixture in which the first has the weight ``persisted``."""
        another = 1.0 - persisted
        self.mean = persisted * mean[0] + another * mean[1]
        between = mean[0] - mean[1]
        merged = persisted * covariance[0] + another * covariance[1]
        merged += (persisted * another) * (between[:, None] * between)
        self.covariance = 0.5 * (merged + merged.T)

    def _move(self) -> tuple[float, float]:
        """What of the offset's height is left to take out of the scan, and out of the map."""
        lift = 0.0
        if self.mean[5] ** 2 > 0.25 * self.covariance[5, 5]:
            lift = -float(self.mean[5])
            self.mean[5] = 0.0
        return float(self.mean[2] - self.mean[5] - self._applied[2]), lift


def _spread(
    covariance: Array, noise: Array, innovation: Array
) -> tuple[Array, Array, Array, list[float]]:
    """P H^T (2, 6, 3), S = H P H^T + R (2, 3, 3), its inverse and i^T S^-1 i of innovations i."""
    cross = covariance[:, :, :3] - covariance[:, :, 3:]
    spread = cross[:, :3] - cross[:, 3:] + noise
    inverse: Array = np.linalg.inv(spread).astype(np.float64, copy=False)
    square = innovation.transpose(0, 2, 1) @ inverse @ innovation
    return cross, spread, inverse, square.ravel().tolist()


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
