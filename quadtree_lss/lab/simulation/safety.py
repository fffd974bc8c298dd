# SPDX-License-Identifier: Apache-2.0
"""True safety: the contact of a four-legged lander with the posts of a DEM (Fig. 21).

Four pads stand on a circle, 90° apart. Each rests on the highest post within its radius, or on the
bilinear surface under its centre. The diagonal with the higher mean carries the vehicle, which
rocks onto either of the other pads, which gives two planes. A place is unsafe if at any yaw a plane
is steeper than the limit, or a post within the circle is higher above it than the clearance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.lab.simulation import contact
from quadtree_lss.lab.simulation.terrain import Terrain
from quadtree_lss.onboard.arrays import Array, Mask

_TOLERANCE = 1e-9  # m: a lander that touches the edge of the DEM is on it


@dataclass(frozen=True)
class LandingGear:
    """Dimensions (m) and limits of the vehicle."""

    diameter: float = 3.7
    pad_radius: float = 0.15
    max_slope_deg: float = 10.0
    max_roughness: float = 0.3
    yaws: int = 16

    @property
    def reach(self) -> float:
        """Distance from the centre to the outer edge of a pad, m."""
        return 0.5 * self.diameter + self.pad_radius

    @property
    def limits(self) -> tuple[float, float, float, float]:
        """Diameter, pad radius, largest slope, deg, and roughness, as in ``truth.npz``."""
        return self.diameter, self.pad_radius, self.max_slope_deg, self.max_roughness


#: The lander of the paper (Fig. 21).
LANDER = LandingGear()


def contact_safe(dem: Terrain, points: ArrayLike, lander: LandingGear = LANDER) -> Mask:
    """Safety (K,) of landers at ``points`` (K, 2), map frame, m; false beyond the DEM."""
    slope, rise = worst_contact(dem, points, lander)
    level = slope <= np.tan(np.radians(lander.max_slope_deg))
    return np.asarray(level & (rise <= lander.max_roughness))


def worst_contact(dem: Terrain, points: ArrayLike, lander: LandingGear) -> tuple[Array, Array]:
    """Largest tangent of the slope (K,) and rise of a post above the plane (K,), m, of all yaws and
    planes, of landers at ``points`` (K, 2); infinite beyond the edge of the DEM."""
    centres = np.asarray(points, np.float64).reshape(-1, 2)
    on = on_dem(dem, centres, lander)
    angles = 0.5 * np.pi / lander.yaws * np.arange(4 * lander.yaws)
    worst, found = np.full((len(centres), 2), np.inf), np.empty((int(on.sum()), 2))
    contact.worst_contacts(
        dem.elevation,
        np.array([dem.x[0], dem.y[0], *dem.post]),
        centres[on],
        np.stack([np.cos(angles), np.sin(angles)], axis=1),
        0.5 * lander.diameter,
        lander.pad_radius,
        found,
    )
    worst[on] = found
    return worst[:, 0], worst[:, 1]


def on_dem(dem: Terrain, points: Array, lander: LandingGear) -> Mask:
    """Whether a lander centred at ``points`` (..., 2) is entirely over the DEM: (...)."""
    reach = lander.reach - _TOLERANCE
    low, high = np.array([(axis[0], axis[-1]) for axis in (dem.x, dem.y)]).T
    return np.asarray(((points - reach >= low) & (points + reach <= high)).all(axis=-1))


def safety_map(dem: Terrain, x: ArrayLike, y: ArrayLike, lander: LandingGear = LANDER) -> Mask:
    """True safety (m, n) at the grid points x (n,), y (m,); see `contact_safe`."""
    points = np.stack(np.meshgrid(x, y), axis=-1)
    return contact_safe(dem, points, lander).reshape(points.shape[:2])
