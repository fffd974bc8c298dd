# SPDX-License-Identifier: Apache-2.0
"""How far the map lies from a prior, as measured ground tells; and whether that is of this place.

Coarsest cells that points have come to describe are compared with the prior, each once. Over the
cell's place x their mean height z is h(x - d) + d_u and an error of variance r: so for each of
`SHIFTS`^2 shifts (d_e, d_n) over three deviations d_u is estimated by a Kalman filter of one
number, and each shift is as likely as the heights are by it. Unlike J = (-a, -b, 1) about a first
shift, that holds where slopes change within the offset, and where two places look alike. Windows
overlap: r counts as often as cells share its posts.

By what was known before, each gap has an expected square. A prior whose gaps are too large for
chi-square is of another place, unit or datum, and is not used any more.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import nan

import numpy as np

from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.core.geometry.morton import squeezed
from quadtree_lss.onboard.core.tree.domain import Domain, carried
from quadtree_lss.onboard.core.tree.leaves import MEASURED, SEEN, LeafTable
from quadtree_lss.onboard.core.tree.prior import FAR, Planes, Prior

#: Shifts along x and along y, from -3 to 3 deviations.
SHIFTS = 37
#: A coarsest cell is compared once points describe so much of it.
SHARE = 0.5
#: Cells before a prior is judged, and deviations that a right one exceeds once in a million.
JUDGED, MOST = 8, 4.753
#: Leaves to come begin from the offset anew, once it is known so much better.
BETTER = 0.8


@dataclass(frozen=True)
class PriorOffset:
    """How far the map lies from its prior.

    Attributes:
        offset: (3,) d: east, north, up, m: the ground at x is the prior's at x - d, and d_u higher.
        covariance: (3, 3) m^2.
        cells: Coarsest cells that were compared.
        misfit: Mean square of their gaps over what was expected; NaN without one.
        covered: Share of the coarsest cells that the prior describes.
        refused: Why the prior is not used any more; empty while it is.
    """

    offset: Array
    covariance: Array
    cells: int
    misfit: float
    covered: float
    refused: str = ""

    @property
    def values(self) -> dict[str, float | int | str]:
        """By name, for diagnostics and files, m."""
        names = ("east", "north", "up", "east_sigma", "north_sigma", "up_sigma")
        numbers = *self.offset.tolist(), *np.sqrt(self.covariance.diagonal()).tolist()
        of_cells = {"cells": self.cells, "misfit": self.misfit, "covered": self.covered}
        return {**dict(zip(names, numbers, strict=True)), **of_cells, "refused": self.refused}

    @property
    def doubt(self) -> str:
        """What is wrong with the prior, in a line; empty if nothing is known to be."""
        if self.refused:
            return f"the prior is not used: {self.refused}"
        return "" if self.covered > 0.0 else "the prior covers nothing of the domain"


class PriorMatch:
    """Compares a map with a prior as it grows, and says what new leaves begin from."""

    def __init__(self, prior: Prior, domain: Domain) -> None:
        import scipy.ndimage  # noqa: F401  takes half a second: not while scans wait

        self.prior, self._domain = prior, domain
        self.reset()

    def reset(self) -> None:
        """The map is empty, or lies elsewhere."""
        config = self.prior.config
        steps = np.linspace(-FAR, FAR, SHIFTS if config.offset_sigma > 0.0 else 1)
        self._step = config.offset_sigma * 2.0 * FAR / (SHIFTS - 1)
        self._east, self._north = np.meshgrid(*[config.offset_sigma * steps] * 2)
        self._log = -0.5 * (steps**2 + steps[:, None] ** 2)
        self._up = np.zeros_like(self._log)
        self._variance = np.full_like(self._log, config.height_sigma**2)
        self._cells, self._squares, self._refused = 0, 0.0, ""
        self._lie_on(self._domain, np.zeros((1 << self._domain.min_level,) * 2, dtype=np.bool_))

    def _lie_on(self, domain: Domain, compared: Mask) -> None:
        self._domain, self._compared = domain, compared
        self._side = domain.size / (1 << domain.min_level)
        self._planes: Planes | None = self.prior.planes(domain, self._side)
        self._begin()
        begun = self._beginning
        self._covered = 0.0 if begun is None else float(np.isfinite(begun[:, 0]).mean())

    def _begin(self) -> None:
        """What leaves begin from, by the offset as it is known now."""
        mean, covariance = self._estimate()
        self._known = covariance.diagonal()
        self._beginning = None
        if self._planes is not None and not self._refused:
            self._beginning = self._planes.beginning(self._domain, mean, covariance)

    def beginning(self, domain: Domain) -> Array | None:
        """(n^2, 5) as of `Planes.beginning`, of the square as it lies now; None where the prior
        says nothing."""
        if domain != self._domain:
            old, side = self._domain, self._side
            east, north = (domain.xmin - old.xmin) / side, (domain.ymin - old.ymin) / side
            self._lie_on(domain, carried(self._compared, round(east), round(north), False))
        return self._beginning

    @property
    def found(self) -> PriorOffset:
        """What is known by now."""
        misfit = self._squares / self._cells if self._cells else nan
        return PriorOffset(*self._estimate(), self._cells, misfit, self._covered, self._refused)

    def learn(self, table: LeafTable) -> None:
        """Compare the coarsest cells that points have come to describe since the last call."""
        if self._refused or self._planes is None or self._compared.all():
            return
        n = 1 << self._domain.min_level
        ix, iy = squeezed(np.arange(n * n))
        described = table.observed.reshape(n * n, -1) > SEEN
        new = (described.mean(axis=1) >= SHARE) & ~self._compared[iy, ix]
        if not new.any():
            return
        self._compared[iy[new], ix[new]] = True
        leaf = table.rows[table.leaf_of.reshape(n * n, -1)[new]]
        weight = (described[new] & (leaf["known"] == MEASURED)).astype(np.float64)
        some = weight.any(axis=1)
        leaf, weight = leaf[some], weight[some] / weight[some].sum(axis=1, keepdims=True)
        for place in zip(*(np.sum(weight * leaf[k], axis=1) for k in "xyz"), strict=True):
            self.compare(*place)
        # A sum of n squares, by Wilson and Hilferty.
        third = 2.0 / (9.0 * max(self._cells, JUDGED))
        most = self._cells * (1.0 - third + MOST * third**0.5) ** 3
        if self._cells >= JUDGED and self._squares > most:
            times = (self._squares / self._cells) ** 0.5
            self._refused = (
                f"over {self._cells} cells the ground departs from it {times:.1f} times as much as"
                " prior.sigma, prior.offset_sigma and prior.height_sigma allow: another place,"
                " unit or datum"
            )
        if self._refused or (self._estimate()[1].diagonal() < BETTER**2 * self._known).any():
            self._begin()

    def compare(self, x: float, y: float, z: float) -> None:
        """Ground of a coarsest cell about a place, m."""
        planes = self._planes
        assert planes is not None
        height, left = planes.at(planes.fields[[0, 3]], x - self._east, y - self._north)
        known = np.isfinite(height)
        if not known.any():
            return
        shared = (planes.width + planes.step) ** 2 / self._side**2
        error = max(shared, 1.0) * (planes.height + np.where(known, left, 0.0))
        gap = np.where(known, z - height - self._up, 0.0)
        expected = self._variance + error
        weight = self._weights() * known
        if weight.sum() > 0.5:
            weight /= weight.sum()
            mean = float(np.sum(weight * gap))
            self._squares += mean**2 / float(np.sum(weight * ((gap - mean) ** 2 + expected)))
            self._cells += 1
        # A shift by which the prior says nothing is as likely as one that is right, on average.
        usual = 1.0 + np.mean(np.log(expected[known]))
        self._log -= 0.5 * np.where(known, gap**2 / expected + np.log(expected), usual)
        gain = np.where(known, self._variance / expected, 0.0)
        self._up += gain * gap
        self._variance *= 1.0 - gain

    def _weights(self) -> Array:
        weight = np.exp(self._log - self._log.max())
        return np.asarray(weight / weight.sum())

    def _estimate(self) -> tuple[Array, Array]:
        """Mean (3,) and covariance (3, 3) of the offset."""
        weight = self._weights().ravel()
        each = np.stack([self._east.ravel(), self._north.ravel(), self._up.ravel()])
        mean = each @ weight
        off = each - mean[:, None]
        within = [self._step**2 / 4.0] * 2 + [float(self._variance.ravel() @ weight)]
        return mean, off * weight @ off.T + np.diag(within)
