# SPDX-License-Identifier: Apache-2.0
"""Trajectories of the lidar, and the poses that navigation estimates along them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from scipy.spatial.transform import Rotation

from quadtree_lss.onboard.arrays import Array

NORTH = (0.0, 1.0, 0.0)
UP = (0.0, 0.0, 1.0)


def look_at(
    position_map: ArrayLike, target_map: ArrayLike, up_map: tuple[float, float, float] = UP
) -> Array:
    """Rotations (..., 3, 3) from the lidar frame (z boresight, x right, y down) to map, for
    positions and targets (..., 3), m. The upper edge of the image points to ``up_map``, or to +y if
    the boresight is parallel to ``up_map``."""
    sight = np.asarray(target_map, float) - np.asarray(position_map, float)
    boresight = sight / np.linalg.norm(sight, axis=-1, keepdims=True)
    right = np.cross(boresight, up_map)
    degenerate = np.linalg.norm(right, axis=-1, keepdims=True) < 1e-9
    fallback = NORTH if up_map != NORTH else UP
    right = np.where(degenerate, np.cross(boresight, fallback), right)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack([right, np.cross(boresight, right), boresight], axis=-1)


@dataclass(frozen=True)
class Trajectory:
    """Position and aim as functions of time (s since the start of the flight)."""

    position: CubicSpline | CubicHermiteSpline
    target: CubicSpline | CubicHermiteSpline
    up_map: tuple[float, float, float] = UP

    def poses(self, times: ArrayLike) -> tuple[Array, Array]:
        """True lidar positions (n, 3) and rotations_map_lidar (n, 3, 3) at times (n,)."""
        t = np.asarray(times, float)
        positions = np.asarray(self.position(t))
        return positions, look_at(positions, np.asarray(self.target(t)), self.up_map)


def _constant(duration: float, point: ArrayLike) -> CubicHermiteSpline:
    value = np.asarray(point, float)
    return CubicHermiteSpline([0.0, duration], [value, value], np.zeros((2, 3)))


def section_vi_trajectory(target_z: float = 0.0) -> Trajectory:
    """Section VI: a cubic of 60 s from (100, −100, 500) m at (−5, −5, −5) m/s to rest 20 m above
    the origin; the boresight points at (10, 0) m on the ground."""
    position = CubicHermiteSpline(
        [0.0, 60.0], [[100.0, -100.0, 500.0], [0.0, 0.0, 20.0]], [[-5.0, -5.0, -5.0], [0.0] * 3]
    )
    return Trajectory(position, _constant(60.0, (10.0, 0.0, target_z)))


@dataclass(frozen=True)
class Sweep:
    """Gimballed sweep of a box and a ``margin`` around it during a straight approach along +x on a
    glide slope. Strips along y from near to far overlap by at least ``overlap`` of the
    footprint."""

    centre_map: tuple[float, float, float]
    half_x: float
    half_y: float
    duration: float
    field_of_view_deg: float
    slant_range: float = 450.0
    glide_slope_deg: float = 30.0
    approach_speed: float = 3.0
    overlap: float = 0.2
    margin: float = 2.0
    reverse: bool = False

    def trajectory(self) -> Trajectory:
        slope = np.radians(self.glide_slope_deg)
        back = np.array([-np.cos(slope), 0.0, np.sin(slope)])
        centre = np.asarray(self.centre_map, float)
        ends = [self.slant_range, self.slant_range - self.approach_speed * self.duration]
        start, stop = (centre + back * length for length in ends)
        velocity = (stop - start) / self.duration
        position = CubicHermiteSpline([0.0, self.duration], [start, stop], [velocity, velocity])
        return Trajectory(position, self._aim(centre, stop))

    def _aim(self, centre: Array, closest: Array) -> CubicSpline:
        """Ground point under the boresight over time: a polyline with rounded turns."""
        half_angle = np.radians(0.5 * self.field_of_view_deg)
        height, distance = closest[2] - centre[2], centre[0] - closest[0]
        # Edges to cover, seen from the closest point, where footprints are smallest.
        edge_x, edge_y = self.half_x + self.margin, self.half_y + self.margin
        # Half length along x and half width along y of the footprint at the near edge.
        away = distance - edge_x
        length = away - height / np.tan(np.arctan2(height, away) + half_angle)
        width = np.hypot(height, away) * np.tan(half_angle)
        turn = edge_y / np.hypot(height, distance)
        first, last = -edge_x + 0.9 * length, edge_x - 0.9 * length
        strips = 1
        if last > first:
            spacing = 2.0 * length * (1.0 - self.overlap)
            strips = 1 + max(1, int(np.ceil((last - first) / spacing)))
        else:
            first = last = 0.0
        end_y = max(edge_y - width + turn * length, 0.0)
        # Continue for a tenth of a second, so that edges are covered more than once.
        end_y += 0.1 * (strips * 2.0 * end_y + last - first) / self.duration
        strip_x = np.linspace(first, last, strips)
        corners = []
        for k, x in enumerate(strip_x):
            side = -1.0 if (k % 2 == 0) != self.reverse else 1.0
            corners += [(x, side * end_y), (x, -side * end_y)]
        return self._along(np.array(corners), centre)

    def _along(self, corners: Array, centre: Array) -> CubicSpline:
        lengths = np.hypot(*np.diff(corners, axis=0).T)
        arc = np.concatenate([[0.0], np.cumsum(lengths)])
        step, rounding = 0.005, 0.25
        pad = round(0.5 * rounding / step)
        times = np.arange(-pad, round(self.duration / step) + pad + 1) * step
        travelled = np.clip(times / self.duration, 0.0, 1.0) * arc[-1]
        keep = np.concatenate([[True], lengths > 0.0])
        path = np.column_stack(
            [np.interp(travelled, arc[keep], corners[keep, axis]) for axis in (0, 1)]
        )
        window = np.hanning(2 * pad + 3)[1:-1]
        window /= window.sum()
        smooth = np.column_stack([np.convolve(path[:, a], window, "valid") for a in (0, 1)])
        aim = np.column_stack([smooth + centre[:2], np.full(len(smooth), centre[2])])
        return CubicSpline(times[pad : pad + len(smooth)], aim)


def descent_trajectory(
    centre_map: ArrayLike, duration: float, high: float = 200.0, low: float = 50.0
) -> Trajectory:
    """Braking descent above a ground point with a decaying sideways drift, looking at it."""
    ground = np.asarray(centre_map, float)
    start = ground + np.array([0.1 * high, -0.06 * high, high])
    stop = ground + np.array([0.0, 0.0, low])
    speed = (stop - start) / duration
    position = CubicHermiteSpline([0.0, duration], [start, stop], [1.5 * speed, 0.3 * speed])
    return Trajectory(position, _constant(duration, ground), NORTH)


@dataclass(frozen=True)
class Estimate:
    """Estimated lidar poses: positions (n, 3), rotations_map_lidar (n, 3, 3), and covariance (6, 6)
    as in PoseWithCovariance, about the fixed axes of the map (m², m·rad, rad²)."""

    positions: Array
    rotations: Array
    covariance: Array


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
        covariance = np.diag([self.position_sigma**2] * 3 + [sigma**2] * 3)
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
        variances = [sigma**2] * 3 + [float(np.hypot(bias, drift)) ** 2] * 3
        covariance = self.conservatism**2 * np.diag(variances)
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
