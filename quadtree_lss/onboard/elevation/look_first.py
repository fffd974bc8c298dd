# SPDX-License-Identifier: Apache-2.0
"""Where to look first, by a prior, before there is a scan. Never a site, nor a target.

Rocks are not in a prior: all it can say is where the ground is even. Over a window as wide as the
lander, of slope s and its deviation sigma_s, the ease of a post is

    e = Phi((tan(limit) - s) / sigma_s) exp(-u^2 / (2 c^2)) ,

u^2 the mean square that the ground departs from the plane by, c the clearance. Of a place it is the
mean over the offset's density and over what a first look covers; what a metre of way to where the
vehicle is going costs is `NEARER`, as for the target.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.grid import best_points
from quadtree_lss.onboard.core.landing.target import NEARER
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.core.tree.prior import Prior

#: What a first look covers, half of its side, in diameters of the vehicle.
HALF = 3.0
#: Places that are named.
MOST = 5


class Look(NamedTuple):
    """A place to look at: map frame, m; slope of the prior there, deg, and the ease of the ground
    about, 0 to 1."""

    x: float
    y: float
    z: float
    slope_deg: float
    ease: float


def look_first(
    prior: Prior, domain: Domain, config: Config, near: Array | None = None
) -> tuple[Look, ...]:
    """Places in the domain where a first look promises most, best first; none where the prior says
    nothing. ``near`` (2,): x and y of where the vehicle is going, m; by default the middle."""
    from scipy.special import ndtr

    vehicle = config.vehicle
    planes = prior.planes(domain, vehicle.diameter)
    if planes is None:
        return ()
    height, a, b, left = planes.fields
    slope, steepest = np.hypot(a, b), np.tan(np.radians(vehicle.max_slope_deg))
    deviation = np.sqrt(planes.slope + 12.0 * left / planes.width**2)
    ease = ndtr((steepest - slope) / deviation) * np.exp(-left / (2.0 * vehicle.clearance**2))
    half = HALF * vehicle.diameter
    # A square of half side w scatters as a Gaussian of w / sqrt(3).
    spread = np.full(2, np.hypot(prior.config.offset_sigma, half / 3.0**0.5))
    about = planes.blurred(ease[None], spread)[0]
    ny, nx = about.shape
    x, y = (
        low + planes.step * np.arange(n) for low, n in zip(planes.corner, (nx, ny), strict=True)
    )
    middle = np.array([domain.xmin, domain.ymin]) + 0.5 * domain.size
    to = middle if near is None else np.asarray(near, dtype=np.float64)[:2]
    cost = 1.0 - about
    cost += NEARER["probability"] * np.hypot(x - to[0], (y - to[1])[:, None])
    within = max(0.5 * domain.size - half, 0.0)
    cost[np.abs(y - middle[1]) > within] = np.nan
    cost[:, np.abs(x - middle[0]) > within] = np.nan
    rows, columns = best_points(cost, x, y, MOST, 2.0 * half)
    at = rows, columns
    slopes = np.degrees(np.arctan(slope[at]))
    found = np.column_stack([x[columns], y[rows], height[at], slopes, about[at]])
    return tuple(Look(*place) for place in found.tolist())
