# SPDX-License-Identifier: Apache-2.0
"""How probable a safe touchdown is: at a place, and where the lander aims at it.

The lander is set down on the map at all headings, or at the one that guidance gives. The true
ground is not the map: how often a lander fails whose worst contact on the map is this, on ground
that is seen so well, was fitted (see ``config.risk.RiskModel``). Nothing of it is a length: all
are shares of the vehicle's diameter and clearance. Where the lander comes down about its aim is
normally distributed, and

    P(safe | aim) = sum over grid points of N(point - aim; dispersion) P(safe at the point).

On unseen ground, on ground that is seen but not yet mapped, and beyond the domain's edge no landing
is safe.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import ceil, exp, isfinite, isnan, log10, radians, tan

import cython
import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array, Bytes, Index, Mask, Single
from quadtree_lss.onboard.config.risk import CAUSES, LOCAL, RiskModel, Row
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing.contact import ContactLimits, Contacts
from quadtree_lss.onboard.core.landing.lattice import GroundPlanes
from quadtree_lss.onboard.core.landing.raster import TerrainRaster

#: Side of the square of the ground under the lander, diameters.
FOOTPRINT = 0.9
#: Nothing counts as higher over the ground at the lander's scale, clearances.
HIGHEST = cython.declare(cython.double, 5.0)
#: Returns on a square as wide as the least hazard that are as good as none.
NO_RETURNS = 1e-3
#: Entries of a table along a curve, and along what is known.
FINE = cython.declare(cython.int, 128)
COARSE = 48
#: Place in `LOCAL` of how well ground is seen.
SEEN = cython.declare(cython.Py_ssize_t, LOCAL.index("seen"))
#: Log odds between which exp is in a table, and entries of it.
LEAST = cython.declare(cython.double, -14.0)
MOST = cython.declare(cython.double, 10.0)
EXPS = cython.declare(cython.int, 4096)
#: A normal distribution is cut off at so many deviations.
TAIL = 4.0
#: The greatest deviation that is taken, m.
WIDEST = 100.0


@dataclass(frozen=True)
class Dispersion:
    """Where the lander comes down about its aim point.

    Attributes:
        x, y: Standard deviations along the axes of the map, m.
        heading: Of the lander, about z from x, rad; None for any.
    """

    x: float
    y: float
    heading: float | None = None

    @staticmethod
    def of(values: ArrayLike | None, lss: LssConfig) -> Dispersion:
        """From standard deviations along x and y, m, and a heading, rad, NaN for any.

        None stands for that of the configuration. Raises `ValueError`: not two or three numbers, or
        no deviations."""
        if values is None:
            return Dispersion(lss.dispersion, lss.dispersion)
        given = np.asarray(values, dtype=np.float64)
        deviations = given[:2]
        if (
            given.shape not in ((2,), (3,))
            or not ((0.0 <= deviations) & (deviations <= WIDEST)).all()
        ):
            msg = f"a dispersion needs two deviations from 0 to {WIDEST:g} m, got {values!r}"
            raise ValueError(msg)
        turned = float(given[2]) if len(given) == 3 else float("nan")
        return Dispersion(float(given[0]), float(given[1]), turned if isfinite(turned) else None)


def contact_limits(model: RiskModel, lss: LssConfig) -> ContactLimits:
    """Contacts that neither the risk model nor the touchdown limits tell apart."""
    vehicle, lengths = lss.vehicle, lss.vehicle.lengths
    least_rise, most_tilt = model.span("rise")[0], model.span("tilt")[1]
    return ContactLimits(
        min(least_rise * vehicle.clearance, lengths.touchdown_roughness),
        max(
            most_tilt * tan(radians(vehicle.max_slope_deg)),
            tan(radians(lengths.touchdown_slope_deg)),
        ),
    )


class RiskTable:
    """A model's probabilities for a lander, laid out to be looked up.

    Args:
        model: The fit.
        lss: The lander.
        noise: Configured range noise of the mapping, one deviation, m.

    Attributes:
        low, per, last: (F,) of what is asked of a place, in the order of `LOCAL`: where its tables
            begin, entries per unit, and the last one.
        terms: (T, 4) cause, which of these, where its table begins, and entries to the next row of
            it, one row for each entry of how well ground is seen; or 0.
        tables: Log odds of all.
        exps: (EXPS,) exp between ``LEAST`` and ``MOST``.
    """

    def __init__(self, model: RiskModel, lss: LssConfig, noise: float) -> None:
        self._model, self._vehicle, self._noise = model, lss.vehicle, noise
        spans = {name: model.span(name) for name in LOCAL}
        steps = {
            name: np.linspace(*span, COARSE if name == "seen" else FINE)
            for name, span in spans.items()
        }
        self.low = np.array([at[0] for at in steps.values()])
        self.last = np.array([len(at) - 1.0 for at in steps.values()])
        self.per = self.last / [at[-1] - at[0] for at in steps.values()]
        tables, terms, first = [], [], 0
        for number, name in enumerate(CAUSES):
            for curve in model.causes[name].curves:
                if curve.of in LOCAL:
                    rows = interpolation_weights(steps[curve.of], curve.knots)
                    odds = np.array(curve.odds) @ rows.T
                    wide = len(odds) > 1
                    if wide:
                        odds = interpolation_weights(steps["seen"], model.seen) @ odds
                    terms.append((number, LOCAL.index(curve.of), first, FINE * wide))
                    tables.append(odds.ravel())
                    first += odds.size
        self.tables = np.concatenate(tables, dtype=np.float32, casting="same_kind")
        self.terms = np.array(terms, dtype=np.int32)
        self.exps = np.exp(np.linspace(LEAST, MOST, EXPS))
        # Of finest cells of one side, as of the map before.
        self._constant: tuple[float, Array] | None = None

    def overall(self, side: float) -> dict[str, float]:
        """What is the same at all places of a map with finest cells of ``side`` m (`OVERALL`)."""
        clearance, diameter = self._vehicle.clearance, self._vehicle.diameter
        return {
            "noise": log10(self._noise / clearance),
            "cell": log10(side / clearance),
            "clearance": log10(clearance / diameter),
            "lean": log10(self._vehicle.leaning / clearance),
        }

    def _worse(self, side: float) -> float:
        """By how much less returns tell than as many of a noise of 0.2 h on cells of 0.85 h, as a
        log10 of their number, on finest cells of ``side`` m; h is the least hazard. A mean shows h
        after as many returns as go with the square of the noise."""
        least = self._vehicle.least_hazard
        wide = max(log10(side / (0.85 * least)), 0.0)
        return 2.0 * log10(self._noise / (0.2 * least)) + 3.0 * wide

    def features(self, raster: TerrainRaster, planes: GroundPlanes, contacts: Contacts) -> Single:
        """What the model asks of each grid point, (F, n + 1, n + 1) in the order of `LOCAL`.

        Args:
            raster: The map.
            planes: The ground at the lander's scale.
            contacts: Contacts on the map, where it is judged and beside that.
        """
        vehicle, side, cells = self._vehicle, raster.domain.finest_size, raster.cells
        clearance, steep = vehicle.clearance, tan(radians(vehicle.max_slope_deg))
        out = np.empty((len(LOCAL), *contacts.rise.shape), dtype=np.float32)
        for k, contact, limit in ((0, contacts.rise, clearance), (2, contacts.tilt, steep)):
            set_contacts(contact, limit, self.low[k], out[k : k + 2])
        known = ~raster.bridged
        # Returns on a square as wide as the least hazard, of those that their leaf has there.
        returns = raster.returns * (vehicle.least_hazard / side) ** 2
        level = np.log10(returns + NO_RETURNS).astype(np.float32)
        rough = np.fmax(cells.roughness / (clearance * cells.size**2), 0.0)
        rough = np.minimum(rough, 2.0).astype(np.float32)
        of_cells = np.empty((3, *known.shape), dtype=np.float32)
        of_leaves = raster.leaf, known.view(np.uint8), level, rough, log10(NO_RETURNS)
        set_known(*of_leaves, of_cells)
        heights = raster.elevation, planes.elevation, raster.seen.view(np.uint8)
        set_relief(*heights, clearance, of_cells[2])
        set_means(of_cells, max(round(0.5 * FOOTPRINT * vehicle.diameter / side), 1), out[5:])
        np.subtract(out[5], np.float32(self._worse(side)), out=out[4])
        np.divide(planes.gradient, steep, out=out[5], casting="same_kind")
        # Of running sums round-off may leave less than nothing.
        np.sqrt(np.maximum(out[6:], np.float32(0.0), out=out[6:]), out=out[6:])
        return out

    def risk(
        self, raster: TerrainRaster, judged: Mask, planes: GroundPlanes, contacts: Contacts
    ) -> tuple[Array, Bytes]:
        """P(unsafe) of landing at each grid point, and what most of it comes from.

        ``judged`` are (n + 1, n + 1) grid points where all ground under the lander is seen; the
        other arguments are as of `features`.

        Returns:
            (n + 1, n + 1) probabilities, 1 where it is not judged; and numbers in `CAUSES`.
        """
        places = self.features(raster, planes, contacts)
        side = raster.domain.finest_size
        if self._constant is None or self._constant[0] != side:
            of = self.overall(side)
            self._constant = side, np.array([self._model.causes[name].at(of) for name in CAUSES])
        out, cause = np.ones(judged.shape), np.zeros(judged.shape, dtype=np.uint8)
        look_up(self, places, judged.view(np.uint8), self._constant[1], out, cause)
        return out, cause


def interpolation_weights(values: Array, knots: Row) -> Array:
    """(N, K) what the values at knots weigh at (N,) places, in the straight lines between them."""
    ones = np.eye(len(knots))
    return np.column_stack([np.interp(values, knots, one) for one in ones])


def aimed(risk: Array, side: float, dispersion: Dispersion) -> Array:
    """P(unsafe | aim) for each grid point as aim.

    Args:
        risk: (ny, nx) P(unsafe) at the grid points; beyond them it is 1.
        side: Between grid points, m.
        dispersion: Of the touchdown about the aim.
    """
    out = np.empty(risk.shape)
    sides = []
    for sigma, count in zip((dispersion.y, dispersion.x), risk.shape, strict=True):
        weights = normal_weights(sigma, side)
        one = weights[len(weights) // 2 :]
        if len(one) > count:  # what is farther from a point than all others lies beyond them
            one = np.append(one[:count], one[count:].sum())
        one = np.append(one, np.zeros(3 - (len(one) + 2) % 4))  # fours, after the first
        sides.append(one.astype(np.float32))
    blur(risk, *sides, out)
    return out


@lru_cache(maxsize=4)
def normal_weights(sigma: float, side: float) -> Array:
    """Weights (2 K + 1,) of grid points about the aim, along one axis."""
    reach = ceil(TAIL * sigma / side)
    if not reach:
        return np.ones(1)
    # Beyond forty deviations there is nothing, and their square may be no number.
    away = [min(abs(k) * side / sigma, 40.0) for k in range(-reach, reach + 1)]
    weights = np.array([exp(-0.5 * of**2) for of in away])
    return np.asarray(weights / weights.sum())


@dataclass(frozen=True)
class Remainder:
    """What most of the risk at an aim point comes from.

    Attributes:
        probability: P(safe | aim).
        away, bearing: Where from the aim, m, and rad from x to y.
        kind: One of `CAUSES`, ``unseen`` or ``unmapped``.
    """

    probability: float
    away: float
    bearing: float
    kind: str

    def words(self) -> str:
        """As in "probability 99.2 %: the remaining risk is an obstacle 3.1 m east"; where none
        is worth a word, the probability alone."""
        share = f"probability {shown(self.probability)}"
        what = {
            "obstacle": "an obstacle",
            "slope": "too steep a slope",
            "hidden": "what the map may not show",
            "unseen": "unseen ground",
            "unmapped": "ground not yet mapped",
        }[self.kind]
        if self.probability >= 0.9999:
            return share
        if self.away < 0.1:
            return f"{share}: the remaining risk is {what} here"
        away = f"{self.away:.1f} m {heading_word(self.bearing)}"
        return f"{share}: the remaining risk is {what} {away}"


def shown(probability: float) -> str:
    """A probability in per cent, with the digits that tell it from certainty; never 100."""
    if isnan(probability):
        return "-"
    share = 100.0 * min(probability, 0.9999)
    return f"{share:.2f} %" if share > 99.9 else f"{share:.1f} %"


def heading_word(bearing: float) -> str:
    """East, north-east ... for an angle from x to y, rad."""
    names = "east north-east north north-west west south-west south south-east".split()
    return names[round(bearing / (0.25 * np.pi)) % 8]


def remaining_risks(
    places: tuple[Index, Index],
    risk: Array,
    judged: Mask,
    unmapped: Mask,
    cause: Bytes,
    side: float,
    dispersion: Dispersion,
) -> list[str]:
    """What most of the risk comes from at aim points, as `Remainder.words` has it.

    Args:
        places: Rows and columns (K,) of the lattice.
        risk: (n + 1, n + 1) P(unsafe) of landing at each grid point.
        judged: (n + 1, n + 1) where it follows from the map.
        unmapped: (n + 1, n + 1) where the lander meets ground that is seen but not yet mapped.
        cause: (n + 1, n + 1) of `RiskTable.risk`.
        side: Between grid points, m.
        dispersion: Of the touchdown about the aim.
    """
    across, along = (
        _middle(normal_weights(sigma, side), count)
        for sigma, count in zip((dispersion.y, dispersion.x), risk.shape, strict=True)
    )
    up, right, within = len(across) // 2, len(along) // 2, float(across.sum() * along.sum())
    found = []
    weights = across[:, None] * along
    for at_row, at_column in zip(*(of.tolist() for of in places), strict=True):
        south, west = max(at_row - up, 0), max(at_column - right, 0)
        known = risk[south : at_row + up + 1, west : at_column + right + 1]
        share = weights.copy()
        south, west = south - at_row + up, west - at_column + right
        share[south : south + known.shape[0], west : west + known.shape[1]] *= known
        row, column = divmod(int(np.argmax(share)), len(along))
        y, x = (row - up) * side, (column - right) * side
        here = row + at_row - up, column + at_column - right
        inside = 0 <= here[0] < risk.shape[0] and 0 <= here[1] < risk.shape[1]
        kind = "unseen"
        if inside and judged[here]:
            kind = CAUSES[cause[here]]
        elif inside and unmapped[here]:
            kind = "unmapped"
        away, bearing = float(np.hypot(x, y)), float(np.arctan2(y, x))
        found.append(Remainder(within - float(share.sum()), away, bearing, kind).words())
    return found


def _middle(weights: Array, count: int) -> Array:
    """Of `normal_weights` those of points of a lattice of so many, as seen from any of them."""
    beyond = max(len(weights) // 2 - count, 0)
    return weights[beyond : len(weights) - beyond]


@cython.boundscheck(False)
@cython.locals(contact=cython.float[:, ::1], limit=cython.float, least=cython.float)
@cython.locals(out=cython.float[:, :, ::1])
def set_contacts(contact: Single, limit: float, least: float, out: Single) -> None:
    """Set ``out`` (2, n, n) to contacts over a limit, ``least`` or more, also where nobody asked,
    and to the greatest of each and its four neighbours."""
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, n=cython.Py_ssize_t)
    cython.declare(south=cython.Py_ssize_t, north=cython.Py_ssize_t)
    n = contact.shape[0]
    with cython.nogil:
        for i in range(n):
            for j in range(n):
                z = contact[i, j] / limit
                out[0, i, j] = z if z > least else least
        for i in range(n):
            south, north = max(i - 1, 0), min(i + 1, n - 1)
            for j in range(n):
                out[1, i, j] = max(out[0, i, j], max(out[0, south, j], out[0, north, j]))
            for j in range(1, n):
                out[1, i, j] = max(out[1, i, j], out[0, i, j - 1])
            for j in range(n - 1):
                out[1, i, j] = max(out[1, i, j], out[0, i, j + 1])


@cython.boundscheck(False)
@cython.locals(leaf=cython.Py_ssize_t[:, ::1], known=cython.uchar[:, ::1])
@cython.locals(level=cython.float[::1], rough=cython.float[::1], none=cython.float)
@cython.locals(out=cython.float[:, :, ::1])
def set_known(
    leaf: Index, known: Bytes, level: Single, rough: Single, none: float, out: Single
) -> None:
    """Set ``out``'s first (2, n, n) to ``level`` and ``rough`` (M,) of the leaves of the ``known``
    finest cells (n, n), and else to ``none`` and 0."""
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    with cython.nogil:
        for i in range(leaf.shape[0]):
            for j in range(leaf.shape[1]):
                out[0, i, j] = level[leaf[i, j]] if known[i, j] else none
                out[1, i, j] = rough[leaf[i, j]] if known[i, j] else 0.0


@cython.boundscheck(False)
@cython.locals(height=cython.double[:, ::1], ground=cython.double[:, ::1])
@cython.locals(seen=cython.uchar[:, ::1], clearance=cython.double, out=cython.float[:, ::1])
def set_relief(height: Array, ground: Array, seen: Bytes, clearance: float, out: Single) -> None:
    """Set ``out`` (n, n) to the square of how far finest cells rise over the ground at the
    lander's scale, clearances, 0 below it and where nothing is ``seen``.

    Args:
        height: (n, n) m.
        ground: (n + 1, n + 1) at the corners of the cells, m.
        seen: (n, n).
        clearance: m.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    with cython.nogil:
        for i in range(out.shape[0]):
            for j in range(out.shape[1]):
                z = ground[i, j] + ground[i, j + 1] + ground[i + 1, j] + ground[i + 1, j + 1]
                z = (height[i, j] - 0.25 * z) / clearance
                z = z if z > 0.0 else 0.0  # also of what is no number
                z = z if z < HIGHEST else HIGHEST
                out[i, j] = z * z if seen[i, j] else 0.0


@cython.boundscheck(False)
@cython.locals(values=cython.float[:, :, ::1], out=cython.float[:, :, ::1])
def set_means(values: Single, reach: cython.Py_ssize_t, out: Single) -> None:
    """Means over squares of cells about each grid point, of what of them lies in the lattice.

    Args:
        values: (3, n, n).
        reach: Cells on either side.
        out: (3, n + 1, n + 1), set.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
    cython.declare(south=cython.Py_ssize_t, north=cython.Py_ssize_t, f=cython.Py_ssize_t)
    cython.declare(west=cython.Py_ssize_t, east=cython.Py_ssize_t, below=cython.Py_ssize_t)
    n: cython.Py_ssize_t = values.shape[1]
    edge: cython.Py_ssize_t = min(reach, n + 1)
    column = cython.declare(cython.double[:, ::1], np.zeros((3, n)))
    sums = cython.declare(cython.double[:, ::1], np.zeros((3, n + 1)))
    below = 0
    with cython.nogil:
        for i in range(n + 1):
            south, north = max(i - reach, 0), min(i + reach, n)
            for f in range(3):
                for k in range(below, north):
                    for j in range(n):
                        column[f, j] += values[f, k, j]
                if i - reach > 0:
                    for j in range(n):
                        column[f, j] -= values[f, i - reach - 1, j]
            below = north
            # Each sum waits for the one before: three at a time wait no longer than one.
            x, y, z = 0.0, 0.0, 0.0
            for j in range(n):
                x += column[0, j]
                y += column[1, j]
                z += column[2, j]
                sums[0, j + 1], sums[1, j + 1], sums[2, j + 1] = x, y, z
            for f in range(3):
                # All but the outermost have squares of the same width.
                share: cython.double = 1.0 / (2 * reach * (north - south))
                for j in range(reach, n + 1 - reach):
                    out[f, i, j] = share * (sums[f, j + reach] - sums[f, j - reach])
                for k in range(2 * edge):
                    j = k if k < edge else n - k + edge
                    west, east = max(j - reach, 0), min(j + reach, n)
                    z = (sums[f, east] - sums[f, west]) / ((east - west) * (north - south))
                    out[f, i, j] = z


@cython.boundscheck(False)
@cython.locals(places=cython.float[:, :, ::1], judged=cython.uchar[:, ::1])
@cython.locals(constant=cython.double[::1])
@cython.locals(out=cython.double[:, ::1], cause=cython.uchar[:, ::1])
def look_up(
    table: RiskTable, places: Single, judged: Bytes, constant: Array, out: Array, cause: Bytes
) -> None:
    """Set P(unsafe) at the ``judged`` grid points (ny, nx), and which cause is the likeliest.

    Args:
        table: Of the model.
        places: (F, ny, nx) what is asked of each.
        constant: (C,) log odds of each cause.
        out, cause: (ny, nx), set where it is judged.
    """
    low = cython.declare(cython.double[::1], table.low)
    per = cython.declare(cython.double[::1], table.per)
    last = cython.declare(cython.double[::1], table.last)
    terms = cython.declare(cython.int[:, ::1], table.terms)
    tables = cython.declare(cython.float[::1], table.tables)
    exps = cython.declare(cython.double[::1], table.exps)
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, t=cython.Py_ssize_t)
    cython.declare(c=cython.Py_ssize_t, f=cython.Py_ssize_t, k=cython.Py_ssize_t)
    cython.declare(first=cython.Py_ssize_t, after=cython.Py_ssize_t)
    columns: cython.Py_ssize_t = out.shape[1]
    causes: cython.Py_ssize_t = constant.shape[0]
    count: cython.Py_ssize_t = places.shape[0]
    entry = cython.declare(cython.int[:, ::1], np.zeros((count, columns), dtype=np.int32))
    seen = cython.declare(cython.int[::1], np.zeros(columns, dtype=np.int32))
    odds = cython.declare(cython.double[:, ::1], np.zeros((causes, columns)))
    least: cython.double = LEAST
    end: cython.double = EXPS - 1
    step: cython.double = (EXPS - 1) / (MOST - LEAST)
    with cython.nogil:
        for i in range(out.shape[0]):
            first, after = 0, columns
            while first < after and not judged[i, first]:
                first += 1
            while after > first and not judged[i, after - 1]:
                after -= 1
            for f in range(count):
                base: cython.double = low[f]
                scale: cython.double = per[f]
                top: cython.double = last[f]
                for j in range(first, after):
                    x: cython.double = (places[f, i, j] - base) * scale + 0.5
                    x = x if x > 0.0 else 0.0  # also of what is no number
                    x = x if x < top else top
                    entry[f, j] = cython.cast(cython.int, x)
            for j in range(first, after):
                seen[j] = FINE * entry[SEEN, j]
            for c in range(causes):
                for j in range(first, after):
                    odds[c, j] = constant[c]
            for t in range(terms.shape[0]):
                c, f, k = terms[t, 0], terms[t, 1], terms[t, 2]
                if terms[t, 3]:
                    for j in range(first, after):
                        odds[c, j] += tables[k + seen[j] + entry[f, j]]
                else:
                    for j in range(first, after):
                        odds[c, j] += tables[k + entry[f, j]]
            for j in range(first, after):
                if not judged[i, j]:
                    continue
                likeliest: cython.uchar = 0
                most: cython.double = odds[0, j]
                worse: cython.double = 1.0
                for c in range(causes):
                    z: cython.double = odds[c, j]
                    likeliest = c if z > most else likeliest
                    most = z if z > most else most
                    z = (z - least) * step + 0.5
                    z = z if z > 0.0 else 0.0
                    z = z if z < end else end
                    worse *= 1.0 + exps[cython.cast(cython.Py_ssize_t, z)]
                out[i, j], cause[i, j] = 1.0 - 1.0 / worse, likeliest


@cython.boundscheck(False)
@cython.locals(risk=cython.double[:, ::1], across=cython.float[::1], along=cython.float[::1])
@cython.locals(out=cython.double[:, ::1])
def blur(risk: Array, across: Single, along: Single, out: Array) -> None:
    """Weighted means of P(unsafe) about each grid point; beyond the lattice it is 1.

    Single precision is enough: nobody knows a risk to a millionth of it.

    Args:
        risk: (ny, nx).
        across, along: (K + 1,), (L + 1,) weights of rows and columns so far from the grid point;
            on both sides they are alike. K and L are multiples of four.
        out: (ny, nx), set.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
    cython.declare(first=cython.Py_ssize_t, after=cython.Py_ssize_t)
    cython.declare(west=cython.Py_ssize_t, east=cython.Py_ssize_t, z=cython.float)
    cython.declare(near=cython.float, far=cython.float, third=cython.float, last=cython.float)
    w: cython.float
    one: cython.float = 1.0
    rows: cython.Py_ssize_t = risk.shape[0]
    columns: cython.Py_ssize_t = risk.shape[1]
    up: cython.Py_ssize_t = across.shape[0] - 1
    right: cython.Py_ssize_t = along.shape[0] - 1
    # Columns of each row at which something is safe within reach along it.
    begin = cython.declare(cython.Py_ssize_t[::1], np.full(rows, columns, dtype=np.intp))
    end = cython.declare(cython.Py_ssize_t[::1], np.zeros(rows, dtype=np.intp))
    # Means along each row.
    means = cython.declare(cython.float[:, ::1], np.ones((rows + 2 * up, columns), np.float32))
    line = cython.declare(cython.float[::1], np.ones(columns + 2 * right, dtype=np.float32))
    with cython.nogil:
        for i in range(rows):
            for j in range(columns):
                line[right + j] = risk[i, j]
            first, after = right, right + columns
            while first < after and line[first] == 1.0:
                first += 1
            while after > first and line[after - 1] == 1.0:
                after -= 1
            if first == after:
                continue
            first, after = max(first - right, right), min(after + right, right + columns)
            begin[i], end[i] = first - right, after - right
            for j in range(first, after):
                means[up + i, j - right] = along[0] * line[j]
            for k in range(1, right, 4):
                near, far, third, last = along[k], along[k + 1], along[k + 2], along[k + 3]
                for j in range(first, after):
                    z = near * (line[j - k] + line[j + k])
                    z += far * (line[j - k - 1] + line[j + k + 1])
                    w = third * (line[j - k - 2] + line[j + k + 2])
                    w += last * (line[j - k - 3] + line[j + k + 3])
                    means[up + i, j - right] = (means[up + i, j - right] + z) + w
        for i in range(rows):
            # The columns in which something is safe within reach.
            west, east = columns, 0
            for k in range(max(i - up, 0), min(i + up + 1, rows)):
                west, east = min(west, begin[k]), max(east, end[k])
            for j in range(west, east):
                line[j] = across[0] * means[up + i, j]
            for k in range(1, up, 4):
                near, far, third, last = across[k], across[k + 1], across[k + 2], across[k + 3]
                south: cython.Py_ssize_t = up + i - k
                north: cython.Py_ssize_t = up + i + k
                for j in range(west, east):
                    z = near * (means[south, j] + means[north, j])
                    z += far * (means[south - 1, j] + means[north + 1, j])
                    w = third * (means[south - 2, j] + means[north + 2, j])
                    w += last * (means[south - 3, j] + means[north + 3, j])
                    line[j] = (line[j] + z) + w
            for j in range(columns):
                out[i, j] = 1.0
            for j in range(west, east):
                out[i, j] = min(line[j], one)
