# SPDX-License-Identifier: Apache-2.0
"""True safety: the contact of a four-legged lander with the posts of a DEM (Fig. 21).

Geometry. Four pads stand on a circle, 90° apart, at fixed horizontal offsets from the vehicle's
centre. Each pad rests on the highest post under it (posts within the pad's radius, and the
bilinear surface under its centre, which matters only where posts are too wide apart for one to lie
under the pad). Four rigid pads touch uneven ground with three: the pads of the diagonal whose mean
height is larger carry the vehicle, and it rocks onto either one of the other two. These are the two
planes through three pads under which the fourth pad's ground does not reach. A place is unsafe
if, at any yaw, either plane is steeper than the limit or any post within the circle is higher above
it (vertically) than the clearance. Yaws divide the 90° after which the four pads repeat.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.lab.simulation import contact
from quadtree_lss.onboard.arrays import Array, Mask

_TOLERANCE = 1e-9  # m: a lander that reaches to the very edge of the DEM is on it


@dataclass(frozen=True)
class LandingGear:
    """Dimensions (m) and limits of the vehicle."""

    diameter: float = 3.7
    pad_radius: float = 0.15
    max_slope_deg: float = 10.0
    max_roughness: float = 0.3
    yaws: int = 16

    @property
    def limits(self) -> tuple[float, float, float, float]:
        """Diameter, radius of a pad, greatest slope in degrees and roughness, for a file."""
        return self.diameter, self.pad_radius, self.max_slope_deg, self.max_roughness


def contact_safe(
    x: ArrayLike,
    y: ArrayLike,
    elevation: ArrayLike,
    points: ArrayLike,
    lander: LandingGear | None = None,
) -> Mask:
    """Whether a lander centred at each of ``points`` (K, 2), map frame, m, stands safely: (K,).

    ``x`` (nx,), ``y`` (ny,), ``elevation`` (ny, nx) are the DEM. A point whose lander would reach
    over the edge of the DEM is unsafe.
    """
    lander = lander or LandingGear()
    slope, rise = worst_contact(x, y, elevation, points, lander)
    return np.asarray(
        (slope <= np.tan(np.radians(lander.max_slope_deg))) & (rise <= lander.max_roughness)
    )


def worst_contact(
    x: ArrayLike, y: ArrayLike, elevation: ArrayLike, points: ArrayLike, lander: LandingGear
) -> tuple[Array, Array]:
    """The worst over yaws and resting planes, for landers at each of ``points`` (K, 2).

    Tangent of the slope (K,), and how far the highest post within the circle is above the plane
    (K,) in m; infinite where the lander would reach over the edge of the DEM. What remains to
    the limits says by how much a place is safe or unsafe.
    """
    posts_x, posts_y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    centres = np.asarray(points, np.float64).reshape(-1, 2)
    on = on_dem(posts_x, posts_y, centres, lander)
    steps = ((axis[-1] - axis[0]) / (axis.size - 1) for axis in (posts_x, posts_y))
    angles = 0.5 * np.pi / lander.yaws * np.arange(4 * lander.yaws)
    worst = np.full((len(centres), 2), np.inf)
    stood = np.empty((int(on.sum()), 2))
    contact.stand(
        np.ascontiguousarray(elevation, np.float64),
        np.array([posts_x[0], posts_y[0], *steps]),
        np.ascontiguousarray(centres[on]),
        np.stack([np.cos(angles), np.sin(angles)], axis=1),
        0.5 * lander.diameter,
        lander.pad_radius,
        stood,
    )
    worst[on] = stood
    return worst[:, 0], worst[:, 1]


def on_dem(x: ArrayLike, y: ArrayLike, points: ArrayLike, lander: LandingGear) -> Mask:
    """Whether all of a lander centred at ``points`` (K, 2) is over the DEM: (K,)."""
    posts_x, posts_y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    centres = np.asarray(points, np.float64).reshape(-1, 2)
    reach = 0.5 * lander.diameter + lander.pad_radius - _TOLERANCE
    return np.asarray(
        (centres[:, 0] - reach >= posts_x[0])
        & (centres[:, 0] + reach <= posts_x[-1])
        & (centres[:, 1] - reach >= posts_y[0])
        & (centres[:, 1] + reach <= posts_y[-1])
    )


def safety_map(
    x: ArrayLike,
    y: ArrayLike,
    elevation: ArrayLike,
    grid_x: ArrayLike,
    grid_y: ArrayLike,
    lander: LandingGear | None = None,
) -> Mask:
    """True safety at the points of a grid: (len(grid_y), len(grid_x)); see `contact_safe`."""
    x_of, y_of = np.asarray(grid_x, np.float64), np.asarray(grid_y, np.float64)
    points = np.stack(np.meshgrid(x_of, y_of), axis=-1).reshape(-1, 2)
    return contact_safe(x, y, elevation, points, lander).reshape(y_of.size, x_of.size)
