# SPDX-License-Identifier: Apache-2.0
"""Ground, places on it, poses, and what a lidar sees of it, without ray casting.

Points are put where the caller wants them in x and y; range noise moves each along its ray. All
lengths in m, all frames the map's unless a name says other.
"""

from collections.abc import Callable

import numpy as np

from quadtree_lss.onboard.core.sensing.lidar import Pose

Array = np.ndarray
Surface = Callable[[Array, Array], Array]

#: Boresight down, right = map x: rotation_map_lidar of a lidar that looks straight down.
LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])
#: A pose as good as exact.
EXACT = 1e-12 * np.eye(6)
#: Over the middle of the small domain.
ABOVE = (8.0, 8.0, 500.0)


def make_pose(
    position: tuple[float, float, float] = (0.0, 0.0, 500.0),
    covariance: Array = EXACT,
    stamp_ns: int = 1_000_000_000,
    rotation: Array = LOOKING_DOWN,
) -> Pose:
    """A pose, straight down and exact unless told."""
    return Pose(stamp_ns, np.asarray(position, dtype=np.float64), rotation, covariance)


def pose_covariance(position_sigma: float, attitude_sigma: float) -> Array:
    """Independent position (m) and attitude (rad) errors."""
    return np.diag([position_sigma**2] * 3 + [attitude_sigma**2] * 3)


def flat(height: float = 0.0) -> Surface:
    """Level ground."""
    return lambda x, y: np.full(np.shape(x), height)


def slope(gradient_x: float, gradient_y: float, height: float = 0.0) -> Surface:
    """Tilted plane z = height + gradient_x x + gradient_y y."""
    return lambda x, y: height + gradient_x * x + gradient_y * y


#: A slope, and its normal.
GRADIENT = (0.12, -0.07)
GROUND = slope(*GRADIENT, 30.0)


def scattered(
    rng: np.random.Generator, xmin: float, ymin: float, size: float, count: int
) -> tuple[Array, Array]:
    """``count`` places drawn uniformly over a square."""
    return xmin + size * rng.random(count), ymin + size * rng.random(count)


def lattice(xmin: float, ymin: float, size: float, per_side: int) -> tuple[Array, Array]:
    """Centres of a regular grid of ``per_side`` by ``per_side`` over a square."""
    step = (np.arange(per_side) + 0.5) * size / per_side
    x, y = np.meshgrid(xmin + step, ymin + step)
    return x.ravel(), y.ravel()


def scan(
    surface: Surface,
    x: Array,
    y: Array,
    true_pose: Pose,
    noise: float,
    rng: np.random.Generator | None = None,
) -> Array:
    """Lidar points (N, 3), lidar axes, of the ground at x, y (N,), range noise along the rays."""
    truth = np.column_stack([x, y, surface(x, y)]) - true_pose.position
    ranges = np.linalg.norm(truth, axis=1)
    if noise > 0.0:
        assert rng is not None
        truth *= (1.0 + noise * rng.standard_normal(len(x)) / ranges)[:, None]
    return truth @ true_pose.rotation_map_lidar
