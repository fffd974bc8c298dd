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
from math import ceil, isfinite, isnan, log10, radians, tan

import cython
import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array, Bytes, Index, Mask, Single
from quadtree_lss.onboard.config.risk import CAUSES, LOCAL, RiskModel, Row
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing.contact import ContactLimits, Contacts
from quadtree_lss.onboard.core.landing.lattice import GroundPlanes, with_neighbours
from quadtree_lss.onboard.core.landing.raster import TerrainRaster
from quadtree_lss.onboard.core.tree.cell_map import CellMap

#: Side of the square of the ground under the lander, diameters.
FOOTPRINT = 0.9
#: Nothing counts as higher over the ground at the lander's scale, clearances.
HIGHEST = 5.0
#: Returns on a square as wide as the least hazard that are as good as none.
NO_RETURNS = 1e-3
#: A cell counts as raised between such heights over the ground at the lander's scale, clearances,
#: if no neighbour is higher: walls, cars and trees do not tell how many rocks are hidden.
RAISED = 0.5, 1.0
#: Side of the surroundings whose raised cells are counted, diameters.
AROUND = 8.0
#: Least share of the range variance in a height: below, rounding decides.
LEAST_SHARE = 1e-3
#: Before anything is seen, this share is raised of a square of so many diameters (half a rock of
#: 0.5 m for a lander of 3.7 m). Of three choices of both sides these had the best log score on 208
#: flights outside the fit.
PRIOR_SHARE, PRIOR_AREA = 0.02, 0.7
#: Entries of a table along a curve, and along what is known.
FINE = cython.declare(cython.int, 128)
COARSE = 48
#: Place in `LOCAL` of how well ground is seen.
SEEN = cython.declare(cython.Py_ssize_t, LOCAL.index("seen"))
#: Log odds between which exp is in a table, and entries of it.
LEAST = cython.declare(cython.double, -14.0)
MOST = cython.declare(cython.double, 10.0)
EXPS = cython.declare(cython.int, 4096)
#: Standard deviations at which a normal distribution is truncated.
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


def height_noise(cells: CellMap, noise: float) -> Array:
    """Return the variance of single heights over that of ranges for each leaf (M,), at most 1.

    A ray that meets the ground at a grazing angle carries little of its range noise into the
    height. The plane's least variance of height, that at the centroid of the returns, times their
    number is the variance of one. ``noise``: standard deviation of ranges, m.
    """
    covariance = cells.covariance_range
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    x, y = covariance[:, 0, 2], covariance[:, 1, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        explained = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
        single = (covariance[:, 2, 2] - explained) * cells.count
    return np.asarray(np.maximum(np.fmin(single / noise**2, 1.0), LEAST_SHARE))


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
        self.per = self.last / [high - low for low, high in spans.values()]
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
        found = np.empty((len(LOCAL), *contacts.rise.shape), dtype=np.float32)
        for k, contact, limit in ((0, contacts.rise, clearance), (2, contacts.tilt, steep)):
            # Contacts that were not needed are NaN.
            np.fmax(contact / np.float32(limit), np.float32(self.low[k]), out=found[k])
            found[k + 1] = with_neighbours(found[k])
        # Returns on a square as wide as the least hazard, of those that their leaf has there.
        returns = raster.returns * (vehicle.least_hazard / side) ** 2
        returns = (returns / height_noise(cells, self._noise)).astype(np.float32)
        rough = np.fmax(cells.roughness / (clearance * cells.size**2), 0.0)
        rough = np.minimum(rough, 2.0).astype(np.float32)
        n, wide = raster.domain.finest_count, AROUND * vehicle.diameter / side
        block = min(1 << max(int(np.log2(max(wide / 16.0, 1.0))), 0), n)
        cell_values = np.empty((4, n, n), dtype=np.float32)
        describe_cells(raster, planes.elevation, returns, rough, clearance, cell_values)
        # By the probability that a return falls on a thing as wide as the least hazard.
        well_seen = 1.0 - np.exp(-cell_values[0])
        blocks = [
            np.add.reduceat(np.add.reduceat(of, np.arange(0, n, block)), np.arange(0, n, block), 1)
            for of in (cell_values[3], well_seen)
        ]
        cell_values[0] = log10(np.e) * np.log(cell_values[0] + np.float32(NO_RETURNS))
        means = square_means(
            cell_values[:3], max(round(0.5 * FOOTPRINT * vehicle.diameter / side), 1)
        )
        np.subtract(means[0], np.float32(self._worse(side)), out=found[4])
        np.divide(planes.gradient, steep, out=found[5], casting="same_kind")
        # Rounding can leave the mean of zeros below zero.
        np.sqrt(np.maximum(means[1:], np.float32(0.0)), out=found[6:8])
        raised, told = square_means(np.stack(blocks), max(round(0.5 * wide / block), 1)) / block**2
        prior = (PRIOR_AREA / AROUND) ** 2
        share = np.maximum((raised + prior * PRIOR_SHARE) / (told + prior), np.float32(1e-6))
        place = np.minimum((np.arange(n + 1) + block // 2) // block, n // block)
        found[8] = np.log10(share)[np.ix_(place, place)]
        return found

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


@cython.boundscheck(False)
@cython.locals(corner=cython.double[:, ::1])
@cython.locals(returns=cython.float[::1], rough=cython.float[::1])
@cython.locals(clearance=cython.double, out=cython.float[:, :, ::1])
def describe_cells(
    raster: TerrainRaster,
    corner: Array,
    returns: Single,
    rough: Single,
    clearance: float,
    out: Single,
) -> None:
    """Describe each finest cell by itself and its neighbours.

    Args:
        raster: The map.
        corner: (n + 1, n + 1) ground at the lander's scale at the cells' corners, m.
        returns: (M,) of leaves on a square as wide as the least hazard.
        rough: (M,) mean deviation from leaves' planes, clearances.
        clearance: m.
        out: (4, n, n), set to the mean of ``returns`` over 3 x 3 cells, ``rough``, the squared
            height over the ground at the lander's scale, clearances, and 1 where a cell is raised.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
    cython.declare(above=cython.Py_ssize_t, below=cython.Py_ssize_t)
    cython.declare(before=cython.Py_ssize_t, after=cython.Py_ssize_t)
    n: cython.Py_ssize_t = out.shape[1]
    leaf = cython.declare(cython.Py_ssize_t[:, ::1], raster.leaf)
    bridged = cython.declare(cython.uchar[:, ::1], raster.bridged.view(np.uint8))
    seen = cython.declare(cython.uchar[:, ::1], raster.seen.view(np.uint8))
    elevation = cython.declare(cython.double[:, ::1], raster.elevation)
    # Of known cells: height over the ground, and returns; then greatest and sum of three in a row.
    rise = cython.declare(cython.float[:, ::1], np.zeros((n, n), dtype=np.float32))
    tops = cython.declare(cython.float[:, ::1], np.empty((n, n), dtype=np.float32))
    count = cython.declare(cython.float[::1], np.zeros(n, dtype=np.float32))
    sums = cython.declare(cython.float[:, ::1], np.empty((n, n), dtype=np.float32))
    highest: cython.double = HIGHEST
    low: cython.float = RAISED[0]
    high: cython.float = RAISED[1]
    ninth: cython.float = 1.0 / 9.0
    with cython.nogil:
        for i in range(n):
            for j in range(n):
                k = leaf[i, j]
                ground = corner[i, j] + corner[i, j + 1] + corner[i + 1, j] + corner[i + 1, j + 1]
                over = max((elevation[i, j] - 0.25 * ground) / clearance, 0.0)
                over = min(over, highest)
                out[1, i, j] = count[j] = 0.0
                out[2, i, j] = over * over * seen[i, j]
                if not bridged[i, j]:
                    out[1, i, j] = rough[k]
                    rise[i, j], count[j] = over, returns[k]
            for j in range(n):
                before, after = max(j - 1, 0), min(j + 1, n - 1)
                sums[i, j] = count[before] + count[j] + count[after]
                tops[i, j] = max(max(rise[i, before], rise[i, j]), rise[i, after])
        for i in range(n):
            above, below = max(i - 1, 0), min(i + 1, n - 1)
            for j in range(n):
                out[0, i, j] = ninth * (sums[above, j] + sums[i, j] + sums[below, j])
                top: cython.float = max(max(tops[above, j], tops[i, j]), tops[below, j])
                out[3, i, j] = rise[i, j] > low and top <= high


def interpolation_weights(values: Array, knots: Row) -> Array:
    """(N, K) what the values at knots weigh at (N,) places, in the straight lines between them."""
    ones = np.eye(len(knots))
    return np.column_stack([np.interp(values, knots, one) for one in ones])


def square_means(values: Single, reach: int) -> Single:
    """Means (F, n + 1, n + 1) over the squares of 2 ``reach`` x 2 ``reach`` cells about each grid
    point, of the part inside the domain; ``values``: (F, n, n) of finest cells."""
    count = values.shape[1]
    out = np.empty((len(values), count + 1, count + 1), dtype=np.float32)
    sum_squares(values, reach, 1.0 / (2 * reach), out)
    point = np.arange(count + 1)
    inside = np.minimum(point + reach, count) - np.maximum(point - reach, 0)
    inside = inside / (2.0 * reach)
    out /= np.outer(inside, inside)
    return out


def aimed(risk: Array, side: float, dispersion: Dispersion) -> Array:
    """P(unsafe | aim) for each grid point as aim.

    Args:
        risk: (ny, nx) P(unsafe) at the grid points; beyond them it is 1.
        side: Between grid points, m.
        dispersion: Of the touchdown about the aim.
    """
    out = np.ones(risk.shape)
    weights = [
        normal_weights(sigma / side, count)
        for sigma, count in zip((dispersion.y, dispersion.x), risk.shape, strict=True)
    ]
    window = []
    for axis in (0, 1):
        reach = len(weights[axis]) // 2
        found = np.flatnonzero((risk < 1.0).any(axis=1 - axis))
        if not len(found):
            return out
        window.append(slice(max(int(found[0]) - reach, 0), int(found[len(found) - 1]) + reach + 1))
    means = np.asarray(risk[tuple(window)], dtype=np.float32)
    for along in reversed(weights):
        reach = len(along) // 2
        means = blur(np.pad(means, ((0, 0), (reach, reach + 3)), constant_values=1.0), along)
    out[tuple(window)] = np.minimum(means, 1.0)
    return out


def normal_weights(sigma: float, count: int) -> Array:
    """Weights (2 K + 1,) of grid points about the aim along one axis, as of `aimed`, up to
    ``count`` steps away; ``sigma``: standard deviation in steps."""
    reach = ceil(TAIL * sigma)
    # A smaller standard deviation has the same weights, and no square that overflows.
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-3)) ** 2)
    beyond = max(reach - count, 0)
    return np.asarray(weights[beyond : len(weights) - beyond] / weights.sum())


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
            "unseen": "unobserved ground",
            "unmapped": "ground observed but not estimated",
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
        normal_weights(sigma / side, count)
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
@cython.locals(values=cython.float[:, ::1])
def blur(values: Single, weights: Array) -> Single:
    """Weighted means along each row of padded values, transposed.

    Single precision is enough: no risk is known to a millionth.

    Args:
        values: (ny, nx + K + 2), of which the last 3 columns do not matter.
        weights: (K,) what their sum lacks to 1 is the weight of ones farther away.

    Returns:
        (nx, ny) means.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
    cython.declare(a=cython.float, b=cython.float, c=cython.float, d=cython.float)
    rows: cython.Py_ssize_t = values.shape[0]
    columns: cython.Py_ssize_t = values.shape[1] - len(weights) - 2
    beyond: cython.float = 1.0 - np.sum(weights)
    # Four at a time, so that a sum is stored less often.
    fours = np.zeros((len(weights) + 3) // 4 * 4, dtype=np.float32)
    fours[: len(weights)] = weights
    weight = cython.declare(cython.float[::1], fours)
    line = cython.declare(cython.float[::1], np.empty(columns, dtype=np.float32))
    out = cython.declare(cython.float[:, ::1], np.empty((columns, rows), dtype=np.float32))
    with cython.nogil:
        for i in range(rows):
            line[:] = beyond
            for k in range(0, weight.shape[0], 4):
                a, b, c, d = weight[k], weight[k + 1], weight[k + 2], weight[k + 3]
                for j in range(columns):
                    line[j] += (a * values[i, j + k] + b * values[i, j + k + 1]) + (
                        c * values[i, j + k + 2] + d * values[i, j + k + 3]
                    )
            for j in range(columns):
                out[j, i] = line[j]
    return np.asarray(out)


@cython.boundscheck(False)
@cython.locals(values=cython.float[:, :, ::1], out=cython.float[:, :, ::1])
def sum_squares(
    values: Single, reach: cython.Py_ssize_t, share: cython.double, out: Single
) -> None:
    """Sums over the squares of `square_means`, times ``share`` along each axis.

    ``values``: (F, n, n). ``out``: (F, n + 1, n + 1), set.
    """
    cython.declare(f=cython.Py_ssize_t, i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    n: cython.Py_ssize_t = values.shape[1]
    columns = cython.declare(cython.double[::1], np.empty(n))
    # Zero outside the domain.
    line = cython.declare(cython.float[::1], np.zeros(n + 2 * reach + 2, dtype=np.float32))
    with cython.nogil:
        for f in range(values.shape[0]):
            columns[:] = 0.0
            for i in range(1 - reach, n + 1):
                if i + reach <= n:
                    for j in range(n):
                        columns[j] += values[f, i + reach - 1, j]
                if i > reach:
                    for j in range(n):
                        columns[j] -= values[f, i - reach - 1, j]
                if i < 0:
                    continue
                for j in range(n):
                    line[reach + 1 + j] = share * columns[j]
                total = 0.0
                for j in range(reach):
                    total += line[reach + 1 + j]
                for j in range(n + 1):
                    out[f, i, j] = share * total
                    after: cython.double = line[j + 2 * reach + 1]
                    total += after - line[j + 1]
