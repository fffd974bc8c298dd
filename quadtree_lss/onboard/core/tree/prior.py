# SPDX-License-Identifier: Apache-2.0
"""Ground that is known before the first scan: planes of an elevation model, with covariance.

Of a window of posts, W wide, with heights z, each with an error of its own, of deviation sigma, the
plane (h, a, b) about its middle is K z, by least squares; its covariance is C = sigma^2 K K^T, and
s^2 is what ground adds to the mean square of the residuals. A model that lies d = (d_e, d_n) too
far west and south, and d_u too low, d of covariance P, says of a place x

    E z = (G * h)(x - d) + d_u,    var z = P_uu + C_hh + G * (h^2 + s^2) - (G * h)^2,

with G the density of d_e, d_n: on even ground J P J^T with J = (-a, -b, 1), and no more linear than
the ground. Slopes alike, with 12 s^2 / W^2 for what the plane leaves out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import PriorConfig
from quadtree_lss.onboard.core.tree.domain import Domain

#: As many deviations of the offset are looked at.
FAR = 3.0
#: From so many steps between posts on a normal distribution is wide.
WIDE = 64.0


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

    def planes(self, domain: Domain, side: float) -> Planes | None:
        """Planes over a square and as far about it as the offset may lead; None where no window of
        posts is whole. ``side``: of what they are wanted for, m: windows are as wide, and of 3 x 3
        posts at least."""
        step = float(self.x[-1] - self.x[0]) / (len(self.x) - 1)
        room = FAR * self.config.offset_sigma + side + 2.0 * step
        inside = [
            np.flatnonzero((axis >= low - room) & (axis <= low + domain.size + room))
            for axis, low in ((self.y, domain.ymin), (self.x, domain.xmin))
        ]
        z = self.elevation[np.ix_(*inside)]
        if min(z.shape) < 3 or not np.isfinite(z).any():
            return None
        corner = self.x[inside[1][0]], self.y[inside[0][0]]
        found = _planes(z, corner, step, side, self.config)
        return found if np.isfinite(found.fields[0]).any() else None


@dataclass(frozen=True)
class Planes:
    """Least-squares planes about each post.

    Attributes:
        corner: x and y of the first post, m; ``step`` between posts, m; ``width`` of windows, m.
        fields: (4, ny, nx) height, m, slope along x and along y, and s^2, m^2; NaN where a window
            lacks a post.
        height, slope: C_hh, m^2, and the variance of either slope.
    """

    corner: tuple[float, float]
    step: float
    width: float
    fields: Array
    height: float
    slope: float

    def at(self, fields: Array, x: Array, y: Array) -> Array:
        """Fields (F, ny, nx) at places of any shape (...), bilinear: (F, ...), NaN outside."""
        from scipy.ndimage import map_coordinates

        place = [(y - self.corner[1]) / self.step, (x - self.corner[0]) / self.step]
        return np.stack([map_coordinates(f, place, order=1, cval=np.nan) for f in fields])

    def blurred(self, fields: Array, deviation: Array) -> Array:
        """Means (F, ny, nx) of fields over the places that an offset of deviations (2,) along x and
        y, m, may mean; NaN where most of these are not known."""
        sigma = deviation[::-1] / self.step
        known = np.isfinite(fields[0])
        share = smoothed(known.astype(np.float64), sigma)
        with np.errstate(invalid="ignore", divide="ignore"):
            means = [smoothed(np.where(known, f, 0.0), sigma) / share for f in fields]
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
        steps = (np.arange(n) + 0.5) * domain.size / n
        x, y = np.meshgrid(domain.xmin + steps - offset[0], domain.ymin + steps - offset[1])
        h, a, b, left, of_h, of_a, of_b = self.at(means, x, y)
        slope = self.slope + np.maximum(of_a, of_b) + 12.0 * left / self.width**2
        height = self.height + np.maximum(of_h, 0.0) + left + covariance[2, 2]
        columns = h + middle + offset[2], a, b, slope, height
        return np.ascontiguousarray(np.stack(columns, axis=-1).reshape(n * n, 5))


def smoothed(field: Array, sigma: Array) -> Array:
    """(ny, nx) weighed by a normal distribution of deviations (2,) along y and x, steps; 0 beyond
    the field. A wide one by Fourier transforms: a filter's time goes with its width."""
    if sigma.max() < WIDE:
        from scipy.ndimage import gaussian_filter

        return np.asarray(gaussian_filter(field, sigma, mode="constant", truncate=FAR))
    from scipy.signal import fftconvolve

    for axis, n in enumerate(field.shape):
        reach = int(FAR * sigma[axis] + 0.5)
        weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma[axis]) ** 2)
        weights /= weights.sum()
        weights = weights[max(reach - n, 0) :][: 2 * n + 1]  # what lies farther meets nothing
        field = fftconvolve(field, np.expand_dims(weights, 1 - axis), "same", axis)
    return field


def _planes(
    z: Array, corner: tuple[float, float], step: float, side: float, config: PriorConfig
) -> Planes:
    from scipy.ndimage import correlate1d

    half = max(round(0.5 * side / step), 1)
    steps = step * np.arange(-half, half + 1)
    mean, line = np.full(len(steps), 1.0 / len(steps)), steps / np.sum(steps**2)

    def over(values: Array, along_y: Array, along_x: Array) -> Array:
        for axis, weights in enumerate((along_y, along_x)):
            values = correlate1d(values, weights, axis, mode="constant", cval=np.nan)
        return values

    of_mean, of_line = mean @ mean, line @ line  # of K K^T
    height, slope = config.sigma**2 * of_mean**2, config.sigma**2 * of_mean * of_line
    middle, spread = np.nanmean(z), np.mean(steps**2)
    z = z - middle
    h, a, b = over(z, mean, mean), over(z, mean, line), over(z, line, mean)
    square = over(z * z, mean, mean) - h * h - (a * a + b * b) * spread
    square -= config.sigma**2 - height - 2.0 * slope * spread
    square *= 1.0 + 3.0 / (len(steps) ** 2 - 3.0)
    fields = np.stack([h + middle, a, b, square])
    planes = Planes(corner, step, 2.0 * half * step, fields, float(height), float(slope))
    # Of few posts a residual says little: that of the ground about.
    left = planes.blurred(square[None], np.full(2, planes.width))[0]
    fields[3] = np.where(np.isfinite(h), np.fmax(left, 0.0), np.nan)
    return planes
