# SPDX-License-Identifier: Apache-2.0
"""Analytic scenes for a flash lidar, independent of the simulator.

The ground is a plane z = gradient . (x, y) with spheres (rocks), cones and boxes. A ray returns
from the nearest of them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.sensing.lidar import Pose

#: Covariance of a practically exact pose: 1 mm and 1 µrad.
EXACT = np.diag([1e-6] * 3 + [1e-12] * 3)


@dataclass(frozen=True)
class Scene:
    """A plane with objects, m.

    Attributes:
        gradient: (2,) dz/dx, dz/dy of the plane, which passes through the origin.
        spheres: (K, 4) centre and radius.
        cones: (K, 5) centre of the base, radius, height over the base.
        boxes: (K, 6) west, south, bottom, east, north, top.
    """

    gradient: tuple[float, float] = (0.0, 0.0)
    spheres: Array = field(default_factory=lambda: np.zeros((0, 4)))
    cones: Array = field(default_factory=lambda: np.zeros((0, 5)))
    boxes: Array = field(default_factory=lambda: np.zeros((0, 6)))

    def plane(self, x: Array, y: Array) -> Array:
        """Height of the plane."""
        return self.gradient[0] * np.asarray(x) + self.gradient[1] * np.asarray(y)

    def dem(self, x: Array, y: Array) -> Array:
        """Height (ny, nx) of the surface over ascending axes (nx,), (ny,)."""
        z = self.plane(x[None, :], y[:, None]) + 0.0

        def window(cx: float, cy: float, r: float) -> tuple[Array, Array, Array]:
            i = slice(*np.searchsorted(y, [cy - r, cy + r]))
            j = slice(*np.searchsorted(x, [cx - r, cx + r]))
            return z[i, j], x[None, j] - cx, y[i, None] - cy

        for cx, cy, cz, r in self.spheres:
            part, east, north = window(cx, cy, r)
            square = r * r - east**2 - north**2
            high = cz + np.sqrt(np.maximum(square, 0.0))
            np.maximum(part, high, out=part, where=square > 0.0)
        for cx, cy, cz, r, h in self.cones:
            part, east, north = window(cx, cy, r)
            distance = np.hypot(east, north)
            np.maximum(part, cz + h * (1.0 - distance / r), out=part, where=distance < r)
        for west, south, _, east, north, top in self.boxes:
            i, j = np.searchsorted(y, [south, north]), np.searchsorted(x, [west, east])
            part = z[slice(*i), slice(*j)]
            np.maximum(part, top, out=part)
        return z

    def near(self, low: Array, high: Array) -> tuple[Scene, Array]:
        """Scene of the objects within a rectangle (2,), (2,), and their numbers."""
        s, c, b = self.spheres, self.cones, self.boxes
        first = np.vstack([s[:, :2] - s[:, 3:], c[:, :2] - c[:, 3:4], b[:, :2]])
        last = np.vstack([s[:, :2] + s[:, 3:], c[:, :2] + c[:, 3:4], b[:, 3:5]])
        here = ((last >= low) & (first <= high)).all(axis=1)
        of = np.split(here, np.cumsum([len(s), len(c)]))
        return Scene(self.gradient, s[of[0]], c[of[1]], b[of[2]]), np.flatnonzero(here)

    def cast(self, origin: Array, rays: Array) -> tuple[Array, Array]:
        """Ranges (N,) along unit rays (N, 3), NaN without a hit, and the hit objects (N,).

        These are -1 for the plane, else the number of the sphere, cone or box, in this order.
        """
        normal = np.array([-self.gradient[0], -self.gradient[1], 1.0])
        with np.errstate(divide="ignore"):
            distance = -(normal @ origin) / (rays @ normal)
        nearest, hit = np.where(distance > 0.0, distance, np.inf), np.full(len(rays), -1)
        number = 0
        for shapes, intersect in ((self.spheres, _sphere), (self.cones, _cone), (self.boxes, _box)):
            for shape in shapes:
                distance = intersect(shape, origin, rays)
                first = distance < nearest
                nearest[first], hit[first] = distance[first], number
                number += 1
        return np.where(np.isfinite(nearest), nearest, np.nan), hit


def _sphere(shape: Array, origin: Array, rays: Array) -> Array:
    to = origin - shape[:3]
    along = rays @ to
    square = along * along - (to @ to - shape[3] ** 2)
    distance = -along - np.sqrt(np.maximum(square, 0.0))
    return np.where((square > 0.0) & (distance > 0.0), distance, np.inf)


def _cone(shape: Array, origin: Array, rays: Array) -> Array:
    """(x - cx)^2 + (y - cy)^2 = (r / h)^2 (top - z)^2 between base and top."""
    to, ratio = origin - shape[:3] - [0.0, 0.0, shape[4]], (shape[3] / shape[4]) ** 2
    metric = np.array([1.0, 1.0, -ratio])
    a, b = (rays * rays) @ metric, rays @ (metric * to)
    square = b * b - a * (to @ (metric * to))
    root = np.sqrt(np.maximum(square, 0.0))
    best = np.full(len(rays), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for distance in ((-b - root) / a, (-b + root) / a):
            z = to[2] + distance * rays[:, 2]
            good = (square > 0.0) & (distance > 0.0) & (z <= 0.0) & (z >= -shape[4])
            best[good] = np.minimum(best, distance)[good]
    return best


def _box(shape: Array, origin: Array, rays: Array) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        first, last = ((corner - origin) / rays for corner in (shape[:3], shape[3:]))
    enter = np.minimum(first, last).max(axis=1)
    leave = np.maximum(first, last).min(axis=1)
    return np.where((enter < leave) & (enter > 0.0), enter, np.inf)


def rocks(places: Array, height: Array, radius: Array, scene: Scene | None = None) -> Array:
    """Spheres (K, 4) whose caps at places (K, 2) have the given heights and radii, (K,) or one."""
    scene = scene or Scene()
    height, radius = (np.broadcast_to(v, len(places)) for v in (height, radius))
    ball = 0.5 * (radius**2 / height + height)
    ground = scene.plane(places[:, 0], places[:, 1])
    return np.column_stack([places, ground + height - ball, ball])


def looking(position: Array, target: Array) -> Array:
    """Rotation (3, 3) from lidar axes (z boresight, x right, y down) to map axes."""
    z = np.asarray(target, np.float64) - position
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 1.0, 0.0] if abs(z[2]) > 0.999 else [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def fan(width_deg: float, pixels: int) -> Array:
    """Unit rays (pixels, pixels, 3) of a flash lidar, in its axes."""
    across = np.tan(np.radians(width_deg) * ((np.arange(pixels) + 0.5) / pixels - 0.5))
    rays = np.stack([*np.meshgrid(across, across), np.ones((pixels, pixels))], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


@dataclass(frozen=True)
class View:
    """A scan: points (H, W, 3) in lidar axes, its true pose, and the hit objects (H, W)."""

    points: Array
    pose: Pose
    hit: Array


def view(
    scene: Scene,
    position: Array,
    target: Array,
    rays: Array,
    noise: float,
    rng: np.random.Generator,
    stamp: float = 1.0,
    keep=None,
) -> View:
    """Scan towards a target from a position; ``keep`` (x, y) selects the scanned ground."""
    position = np.asarray(position, np.float64)
    turn = looking(position, target)
    flat = rays.reshape(-1, 3) @ turn.T
    # Consider only the objects within the footprint, with a margin of 2 m.
    reach, _ = Scene(scene.gradient).cast(position, flat)
    places = position + reach[:, None] * flat
    low, high = np.nanmin(places[:, :2], axis=0) - 2.0, np.nanmax(places[:, :2], axis=0) + 2.0
    there, number = scene.near(low, high)
    ranges, hit = there.cast(position, flat)
    hit = np.append(number, -1)[hit]
    if keep is not None:
        x, y, _ = (position + ranges[:, None] * flat).T
        ranges = np.where(keep(x, y), ranges, np.nan)
    hit = np.where(np.isfinite(ranges), hit, -1)
    ranges = ranges + noise * rng.standard_normal(len(ranges))
    points = (ranges[:, None] * rays.reshape(-1, 3)).reshape(rays.shape)
    pose = Pose(round(1e9 * stamp), position, turn, EXACT)
    return View(points, pose, hit.reshape(rays.shape[:2]))
