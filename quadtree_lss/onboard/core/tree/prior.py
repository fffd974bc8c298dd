# SPDX-License-Identifier: Apache-2.0
"""Ground that is known before the first scan: planes of an elevation model, with covariance.

Of a window of posts, W wide, with heights z and errors of covariance R (deviation sigma,
correlation exp(-r^2 / 2 L^2)), the plane (h, a, b) about its middle is K z, K = (A^T A)^-1 A^T with
rows (1, x, y) of A; its covariance is K R K^T, and s^2 is what ground adds to the mean square of
the residuals, (z - A K z)^2 / (N - 3), beyond tr((I - A K) R) / (N - 3). A model that lies
d = (d_e, d_n) too far west and south, and d_u too low, d of covariance P, says of a place x

    E z = (G * h)(x - d) + d_u,    var z = P_uu + (K R K^T)_hh + G * (h^2 + s^2) - (G * h)^2,

with G the density of d_e, d_n: on even ground J P J^T with J = (-a, -b, 1), and no more linear than
the ground. Slopes alike, with 12 s^2 / W^2 for what the plane leaves out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import PriorConfig
from quadtree_lss.onboard.core.tree.domain import Domain

#: Posts along a side that the covariance of a window is reckoned with; of a wider one so many of
#: its posts stand for all.
STENCIL = 13
#: As many deviations of the offset are looked at.
FAR = 3.0


@dataclass(frozen=True)
class Prior:
    """Heights of the ground by somebody else.

    Attributes:
        x, y: (nx,), (ny,) posts in the map frame, ascending, evenly spaced alike, m.
        elevation: (ny, nx) m, NaN where it is not known.
        config: How well.
    """

    x: Array
    y: Array
    elevation: Array
    config: PriorConfig

    @property
    def spacing(self) -> float:
        """Distance of neighbouring posts, m."""
        return float(self.x[-1] - self.x[0]) / (len(self.x) - 1)

    def planes(self, domain: Domain, side: float) -> Planes | None:
        """Planes over a square and as far about it as the offset may lead; None where no post is
        near. ``side``: of what they are wanted for, m: windows are as wide, and of 3 x 3 posts at
        least."""
        room = FAR * self.config.offset_sigma + side + 2.0 * self.spacing
        inside = [
            np.flatnonzero((axis >= low - room) & (axis <= low + domain.size + room))
            for axis, low in ((self.y, domain.ymin), (self.x, domain.xmin))
        ]
        if min(map(len, inside)) < 3:
            return None
        z = self.elevation[np.ix_(*inside)]
        if not np.isfinite(z).any():
            return None
        return _planes(self, z, (self.x[inside[1][0]], self.y[inside[0][0]]), side)


@dataclass(frozen=True)
class Planes:
    """Least-squares planes about each post.

    Attributes:
        corner: x and y of the first post, m; ``step`` between posts, m; ``width`` of windows, m.
        fields: (4, ny, nx) height, m, slope along x and along y, and s^2, m^2; NaN where a window
            lacks a post.
        height, slope: (K R K^T)_hh, m^2, and the greater of the slopes' variances.
    """

    corner: tuple[float, float]
    step: float
    width: float
    fields: Array
    height: float
    slope: float

    def at(self, fields: Array, x: Array, y: Array) -> Array:
        """Fields (F, ny, nx) at places of any shape (...), bilinear: (F, ...), NaN outside."""
        from scipy import ndimage

        place = np.stack([(y - self.corner[1]) / self.step, (x - self.corner[0]) / self.step])
        flat = place.reshape(2, -1)
        found = [ndimage.map_coordinates(f, flat, order=1, cval=np.nan) for f in fields]
        return np.reshape(found, (len(fields), *place.shape[1:]))

    def blurred(self, fields: Array, deviation: Array) -> Array:
        """Means (F, ny, nx) of fields over the places that an offset of deviations (2,) along x and
        y, m, may mean; NaN where most of these are not known."""
        sigma = deviation[::-1] / self.step

        def blur(values: Array) -> Array:
            from scipy import ndimage

            found: Array = ndimage.gaussian_filter(values, sigma, mode="constant", truncate=FAR)
            return found

        known = np.isfinite(fields[0])
        share = blur(known.astype(np.float64))
        with np.errstate(invalid="ignore", divide="ignore"):
            means = [blur(np.where(known, field, 0.0)) / share for field in fields]
        return np.where(share > 0.5, means, np.nan)

    def beginning(self, domain: Domain, offset: Array, covariance: Array) -> Array:
        """What leaves of the coarsest cells of a square begin from.

        Args:
            domain: The square.
            offset: (3,) d, m. covariance: (3, 3) P, m^2.

        Returns:
            (n^2, 5), row iy n + ix: height at the cell's middle, m, slope along x and along y,
            variance of either slope, and of the height, m^2; NaN where the ground is not known.
        """
        h, a, b, left = self.fields
        middle = np.nanmean(h)
        h = h - middle  # squares of small numbers lose nothing
        deviation = np.sqrt(np.diag(covariance)[:2])
        means = self.blurred(np.stack([h, a, b, left, h * h, a * a, b * b]), deviation)
        means[4:] -= means[:3] ** 2
        n = 1 << domain.min_level
        side = domain.size / n
        steps = (np.arange(n) + 0.5) * side
        x, y = np.meshgrid(domain.xmin + steps - offset[0], domain.ymin + steps - offset[1])
        h, a, b, left, of_h, of_a, of_b = self.at(means, x, y)
        slope = self.slope + np.maximum(of_a, of_b) + 12.0 * left / self.width**2
        height = self.height + np.maximum(of_h, 0.0) + left + covariance[2, 2]
        columns = h + middle + offset[2], a, b, slope, height
        return np.ascontiguousarray(np.stack(columns, axis=-1).reshape(n * n, 5))


def _planes(prior: Prior, z: Array, corner: tuple[float, float], side: float) -> Planes:
    step, config = prior.spacing, prior.config
    half = max(round(0.5 * side / step), 1)
    steps = step * np.arange(-half, half + 1)
    mean, line = np.full(len(steps), 1.0 / len(steps)), steps / np.sum(steps**2)

    def over(values: Array, along_y: Array, along_x: Array) -> Array:
        from scipy import ndimage

        for axis, weights in enumerate((along_y, along_x)):
            values = ndimage.correlate1d(values, weights, axis, mode="constant", cval=np.nan)
        return values

    middle = np.nanmean(z)
    z = z - middle
    h, a, b = over(z, mean, mean), over(z, mean, line), over(z, line, mean)
    count = len(steps) ** 2
    square = over(z * z, mean, mean) - h * h - (a * a + b * b) * np.mean(steps**2)
    square *= count / (count - 3.0)
    thin = np.unique(np.round(np.linspace(0, 2 * half, STENCIL)).astype(int))
    y, x = (axis.ravel() for axis in np.meshgrid(steps[thin], steps[thin], indexing="ij"))
    places = np.column_stack([np.ones_like(x), x, y])
    away = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2
    length = config.correlation_length
    errors = np.exp(-away / (2.0 * length**2)) if length > 0.0 else np.eye(len(x))
    errors *= config.sigma**2
    solve = np.linalg.pinv(places)
    covariance = solve @ errors @ solve.T
    noise = np.trace(errors - places @ solve @ errors) / (len(x) - 3.0)
    planes = Planes(
        corner, step, 2.0 * half * step, np.stack([h + middle, a, b, square]),
        float(covariance[0, 0]), float(max(covariance[1, 1], covariance[2, 2])),
    )  # fmt: skip
    # Of few posts a residual says little: that of the ground about.
    about = np.full(2, planes.width)
    left = planes.blurred((square - noise)[None], about)[0]
    known = np.isfinite(h)
    planes.fields[3] = np.where(
        known, np.maximum(np.where(np.isfinite(left), left, 0.0), 0.0), np.nan
    )
    return planes


def covered(prior: Prior, domain: Domain) -> float:
    """Share of a square that posts with heights cover."""
    known = np.isfinite(prior.elevation)
    inside = (prior.y[:, None] >= domain.ymin) & (prior.y[:, None] < domain.ymin + domain.size)
    inside = inside & (prior.x >= domain.xmin) & (prior.x < domain.xmin + domain.size)
    posts = np.count_nonzero(known & inside) * prior.spacing**2
    return float(min(posts / domain.size**2, 1.0))
