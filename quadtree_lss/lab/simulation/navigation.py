# SPDX-License-Identifier: Apache-2.0
"""Errors of navigation and the covariance that it reports."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from quadtree_lss.onboard.arrays import Array


@dataclass(frozen=True)
class Estimate:
    """Estimated lidar poses: positions (n, 3), rotations_map_lidar (n, 3, 3), and covariance (6, 6)
    as in PoseWithCovariance, about the fixed axes of the map (m², m·rad, rad²)."""

    positions: Array
    rotations: Array
    covariance: Array


def _isotropic(position_sigma: float, attitude_sigma: float) -> Array:
    return np.diag([position_sigma**2] * 3 + [attitude_sigma**2] * 3)


@dataclass(frozen=True)
class WhiteNavigation:
    """Independent isotropic errors of each pose (right perturbation of Eq. 16) with their true
    covariance."""

    position_sigma: float = 0.5
    attitude_sigma_deg: float = 0.01

    def estimate(
        self, generator: np.random.Generator, times: Array, positions: Array, rotations: Array
    ) -> Estimate:
        """Estimate true poses (n, 3), (n, 3, 3) at times (n,), s."""
        sigma = np.radians(self.attitude_sigma_deg)
        offset = generator.normal(0.0, self.position_sigma, positions.shape)
        tilt = Rotation.from_rotvec(generator.normal(0.0, sigma, positions.shape)).as_matrix()
        covariance = _isotropic(self.position_sigma, sigma)
        return Estimate(positions + offset, rotations @ tilt, covariance)


@dataclass(frozen=True)
class DriftingNavigation:
    """A constant bias and a first-order Gauss–Markov drift about the fixed axes of the map. The
    reported standard deviation is that of their sum times ``conservatism``."""

    position_bias: float = 0.03
    position_drift: float = 0.01
    attitude_bias_deg: float = 0.01
    attitude_drift_deg: float = 0.0015
    correlation_time: float = 10.0
    conservatism: float = 2.0

    def estimate(
        self, generator: np.random.Generator, times: Array, positions: Array, rotations: Array
    ) -> Estimate:
        """Estimate true poses as `WhiteNavigation.estimate` does."""
        offset = self._error(generator, times, self.position_bias, self.position_drift)
        bias, drift = np.radians([self.attitude_bias_deg, self.attitude_drift_deg])
        tilt = Rotation.from_rotvec(self._error(generator, times, bias, drift)).as_matrix()
        sigma = float(np.hypot(self.position_bias, self.position_drift))
        covariance = self.conservatism**2 * _isotropic(sigma, float(np.hypot(bias, drift)))
        return Estimate(positions + offset, tilt @ rotations, covariance)

    def _error(
        self, generator: np.random.Generator, times: Array, bias: float, drift: float
    ) -> Array:
        """Bias plus drift (n, 3): exact discretisation of the Gauss–Markov process."""
        constant = generator.normal(0.0, bias, 3)
        white = generator.standard_normal((times.size, 3))
        decay = np.exp(-np.diff(times, prepend=times[:1]) / self.correlation_time)
        gain = drift * np.sqrt(1.0 - decay**2)
        shocks = gain[:, None] * white
        wander, kept = np.empty_like(white), decay.tolist()
        for axis, state in enumerate((drift * white[0]).tolist()):  # floats: an array is slow
            for k, (share, new) in enumerate(zip(kept, shocks[:, axis].tolist(), strict=True)):
                state = share * state + new
                wander[k, axis] = state
        return np.asarray(constant + wander)


Navigation = WhiteNavigation | DriftingNavigation
