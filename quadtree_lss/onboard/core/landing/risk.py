# SPDX-License-Identifier: Apache-2.0
"""Step 3 of an assessment: the predicted risk of a touchdown at each grid point.

The risk model (``config.risk.RiskModel``) was fitted to simulated flights. It gives the probability
of a failure on the true ground for a contact on the map and a density of returns. All features are
relative to the vehicle's diameter and clearance. The risk is 1 where it cannot be assessed.
"""

from __future__ import annotations

from math import log10, radians, tan

import cython
import numpy as np

from quadtree_lss.onboard.arrays import Array, Bytes, Single
from quadtree_lss.onboard.config.risk import CAUSES, LOCAL, RiskModel, Row, model_warning
from quadtree_lss.onboard.config.settings import Config, LssConfig
from quadtree_lss.onboard.config.vehicle import VehicleConfig
from quadtree_lss.onboard.core.landing.contact import ContactLimits, Contacts, touchdown_limits
from quadtree_lss.onboard.core.landing.lattice import with_neighbours
from quadtree_lss.onboard.core.landing.raster import TerrainRaster
from quadtree_lss.onboard.core.tree.cell_map import CellMap

#: Side of the square of ground under the vehicle, diameters.
FOOTPRINT = 0.9
#: Greatest height over the ground at the vehicle's scale, clearances; greater ones are clipped.
MAX_HEIGHT = 5.0
#: Added to the returns on a square as wide as the least hazard: their logarithm stays finite.
NO_RETURNS = 1e-3
#: A cell counts as raised between these heights over the ground at the vehicle's scale, clearances,
#: if no neighbour is higher: walls, cars and trees do not indicate hidden rocks.
RAISED = 0.5, 1.0
#: Side of the square about a grid point in which raised cells are counted, diameters.
NEIGHBOURHOOD = 8.0
#: Least ratio of height to range variance: below, rounding dominates.
MIN_VARIANCE_RATIO = 1e-3
#: Prior of the share of raised cells, and its weight as the side of a square of observed ground,
#: diameters. Of three choices of both sides these had the best log score on 208 flights outside the
#: fit.
PRIOR_SHARE, PRIOR_SIDE = 0.02, 0.7
#: Entries of a table along a curve, and along the density of returns.
CURVE_ENTRIES = cython.declare(cython.int, 128)
DENSITY_ENTRIES = 48
#: Index of the density of returns in `LOCAL`.
DENSITY = cython.declare(cython.Py_ssize_t, LOCAL.index("seen"))
#: Range of log odds in the table of exp, and its entries.
MIN_ODDS = cython.declare(cython.double, -14.0)
MAX_ODDS = cython.declare(cython.double, 10.0)
EXP_ENTRIES = cython.declare(cython.int, 4096)
#: Greatest bridged share of the assessable ground without a warning: flights of the fit have up to
#: 0.02.
MAX_BRIDGED = 0.05


def height_noise(cells: CellMap, noise: float) -> Array:
    """Return the ratio of height to range variance of single returns in each leaf (M,), at most 1.

    At a grazing angle, little of the range noise affects the height. The plane's least height
    variance, at the centroid of the returns, times their number is the height variance of one.
    ``noise``: standard deviation of ranges, m.
    """
    covariance = cells.covariance_range
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    x, y = covariance[:, 0, 2], covariance[:, 1, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        explained = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
        single = (covariance[:, 2, 2] - explained) * cells.count
    return np.asarray(np.maximum(np.fmin(single / noise**2, 1.0), MIN_VARIANCE_RATIO))


def contact_limits(model: RiskModel, lss: LssConfig) -> ContactLimits:
    """Return the range in which risk model and touchdown limits need exact contacts."""
    vehicle, touchdown = lss.vehicle, touchdown_limits(lss)
    min_rise = model.span("rise")[0] * vehicle.clearance
    max_tilt = model.span("tilt")[1] * tan(radians(vehicle.max_slope_deg))
    return ContactLimits(min(min_rise, touchdown.min_rise), max(max_tilt, touchdown.max_tilt))


class RiskTable:
    """Tables of a model's log odds for one vehicle; ``noise``: configured range noise, m.

    Attributes:
        low, per, last: (F,) per feature in the order of `LOCAL`: its value at the first entry of
            its tables, entries per unit, and the last entry.
        terms: (T, 4) per table: cause, feature, index of the first entry, and whether there is a
            row per density of returns.
        tables: Log odds of all tables.
        exp_table: (EXP_ENTRIES,) exp of log odds between `MIN_ODDS` and `MAX_ODDS`.
    """

    def __init__(self, model: RiskModel, lss: LssConfig, noise: float) -> None:
        self._model, self._vehicle, self._noise = model, lss.vehicle, noise
        spans = {name: model.span(name) for name in LOCAL}
        steps = {
            name: np.linspace(*span, DENSITY_ENTRIES if name == "seen" else CURVE_ENTRIES)
            for name, span in spans.items()
        }
        self.low = np.array([values[0] for values in steps.values()])
        self.last = np.array([len(values) - 1.0 for values in steps.values()])
        self.per = self.last / [high - low for low, high in spans.values()]
        tables, terms, first = [], [], 0
        for number, name in enumerate(CAUSES):
            for curve in model.causes[name].curves:
                if curve.feature in LOCAL:
                    rows = interpolation_weights(steps[curve.feature], curve.knots)
                    odds = np.array(curve.odds) @ rows.T
                    wide = len(odds) > 1
                    if wide:
                        odds = interpolation_weights(steps["seen"], model.seen) @ odds
                    terms.append((number, LOCAL.index(curve.feature), first, wide))
                    tables.append(odds.ravel())
                    first += odds.size
        self.tables = np.concatenate(tables, dtype=np.float32, casting="same_kind")
        self.terms = np.array(terms, dtype=np.int32)
        self.exp_table = np.exp(np.linspace(MIN_ODDS, MAX_ODDS, EXP_ENTRIES))

    def overall(self, side: float) -> dict[str, float]:
        """Return the features `OVERALL` of a map with finest cells of ``side``, m."""
        clearance, diameter = self._vehicle.clearance, self._vehicle.diameter
        return {
            "noise": log10(self._noise / clearance),
            "cell": log10(side / clearance),
            "clearance": log10(clearance / diameter),
            "lean": log10(self._vehicle.tilt_height / clearance),
        }

    def features(self, raster: TerrainRaster, contacts: Contacts) -> Single:
        """Compute the features of each grid point, (F, n + 1, n + 1) in the order of `LOCAL`."""
        vehicle, side, planes = self._vehicle, raster.domain.finest_size, raster.planes
        clearance, steep = vehicle.clearance, tan(radians(vehicle.max_slope_deg))
        found = np.empty((len(LOCAL), *contacts.rise.shape), dtype=np.float32)
        for k, contact, limit in ((0, contacts.rise, clearance), (2, contacts.tilt, steep)):
            # Contacts that were not needed are NaN.
            np.fmax(contact / np.float32(limit), np.float32(self.low[k]), out=found[k])
            found[k + 1] = with_neighbours(found[k])
        n, wide = raster.domain.finest_count, NEIGHBOURHOOD * vehicle.diameter / side
        cell_values = describe_cells(raster, vehicle, self._noise)
        # Probability that a return falls on an object as wide as the least hazard.
        hit = 1.0 - np.exp(-cell_values[0])
        block = min(1 << max(int(np.log2(max(wide / 16.0, 1.0))), 0), n)
        starts = np.arange(0, n, block)
        blocks = [
            np.add.reduceat(np.add.reduceat(values, starts), starts, 1)
            for values in (cell_values[3], hit)
        ]
        cell_values[0] = log10(np.e) * np.log(cell_values[0] + np.float32(NO_RETURNS))
        means = square_means(
            cell_values[:3], max(round(0.5 * FOOTPRINT * vehicle.diameter / side), 1)
        )
        # The number of returns whose mean shows the least hazard h is proportional to the square of
        # the noise; it is 1 at a noise of 0.2 h on cells of 0.85 h.
        least = vehicle.least_hazard
        loss = 2.0 * log10(self._noise / (0.2 * least))
        loss += 3.0 * max(log10(side / (0.85 * least)), 0.0)
        np.subtract(means[0], np.float32(loss), out=found[4])
        np.divide(planes.gradient, steep, out=found[5], casting="same_kind")
        # Rounding can make the mean of zeros negative.
        np.sqrt(np.maximum(means[1:], np.float32(0.0)), out=found[6:8])
        raised, hits = square_means(np.stack(blocks), max(round(0.5 * wide / block), 1)) / block**2
        prior = (PRIOR_SIDE / NEIGHBOURHOOD) ** 2
        share = np.maximum((raised + prior * PRIOR_SHARE) / (hits + prior), np.float32(1e-6))
        index = np.minimum((np.arange(n + 1) + block // 2) // block, n // block)
        np.take(np.log10(share).take(index, axis=0), index, axis=1, out=found[8])
        return found

    def risk(self, raster: TerrainRaster, contacts: Contacts) -> tuple[Array, Bytes]:
        """Predict the risk (n + 1, n + 1) at each grid point, 1 where it cannot be assessed.

        Also return the main cause, as an index of `CAUSES`.
        """
        features = self.features(raster, contacts)
        overall = self.overall(raster.domain.finest_size)
        constant = np.array([self._model.causes[name].map_log_odds(overall) for name in CAUSES])
        assessable = raster.assessable
        out, cause = np.ones(assessable.shape), np.zeros(assessable.shape, dtype=np.uint8)
        look_up(self, features, assessable.view(np.uint8), constant, out, cause)
        return out, cause


def risk_warnings(config: Config, raster: TerrainRaster) -> tuple[str, ...]:
    """List the reasons why the predicted risks may be wrong, one line each: the run is outside the
    fit, or more of the assessable ground is bridged than in it."""
    warning, assessable = model_warning(config), raster.assessable[1:, 1:]
    warnings = (warning,) if warning else ()
    share = np.count_nonzero(raster.bridged & assessable) / (np.count_nonzero(assessable) or 1)
    if share <= MAX_BRIDGED:
        return warnings
    return (
        *warnings,
        f"{100.0 * share:.0f} % of the judged ground has no return and is bridged; the risk model"
        f" was fitted to flights with at most {100.0 * MAX_BRIDGED:.0f} %",
    )


@cython.boundscheck(False)
def describe_cells(raster: TerrainRaster, vehicle: VehicleConfig, noise: float) -> Single:
    """Describe each finest cell (4, n, n) by: mean number of returns of 3 x 3 cells on a square as
    wide as the least hazard; mean distance of the leaf's points to its plane, clearances; squared
    height over the ground at the vehicle's scale, clearances; 1 if raised. ``noise``: as above."""
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
    cython.declare(before=cython.Py_ssize_t, after=cython.Py_ssize_t)
    n: cython.Py_ssize_t = raster.domain.finest_count
    clearance: cython.double = vehicle.clearance
    cells, share = raster.cells, (vehicle.least_hazard / raster.domain.finest_size) ** 2
    per_leaf = (raster.returns * share / height_noise(cells, noise)).astype(np.float32)
    returns = cython.declare(cython.float[::1], per_leaf)
    distance = np.fmax(cells.roughness / (vehicle.clearance * cells.size**2), 0.0)
    rough = cython.declare(cython.float[::1], np.minimum(distance, 2.0).astype(np.float32))
    out = cython.declare(cython.float[:, :, ::1], np.empty((4, n, n), dtype=np.float32))
    corner = cython.declare(cython.double[:, ::1], raster.planes.elevation)
    leaf = cython.declare(cython.Py_ssize_t[:, ::1], raster.leaf)
    bridged = cython.declare(cython.uchar[:, ::1], raster.bridged.view(np.uint8))
    observed = cython.declare(cython.uchar[:, ::1], raster.observed.view(np.uint8))
    elevation = cython.declare(cython.double[:, ::1], raster.elevation)
    # Height over the ground and returns of known cells; then maximum and sum of three in a row.
    rise = cython.declare(cython.float[:, ::1], np.zeros((n, n), dtype=np.float32))
    tops = cython.declare(cython.float[:, ::1], np.empty((n, n), dtype=np.float32))
    count = cython.declare(cython.float[::1], np.zeros(n, dtype=np.float32))
    sums = cython.declare(cython.float[:, ::1], np.empty((n, n), dtype=np.float32))
    highest: cython.double = MAX_HEIGHT
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
                out[2, i, j] = over * over * observed[i, j]
                if not bridged[i, j]:
                    out[1, i, j] = rough[k]
                    rise[i, j], count[j] = over, returns[k]
            for j in range(n):
                before, after = max(j - 1, 0), min(j + 1, n - 1)
                sums[i, j] = count[before] + count[j] + count[after]
                tops[i, j] = max(max(rise[i, before], rise[i, j]), rise[i, after])
        for i in range(n):
            before, after = max(i - 1, 0), min(i + 1, n - 1)
            for j in range(n):
                out[0, i, j] = ninth * (sums[before, j] + sums[i, j] + sums[after, j])
                top: cython.float = max(max(tops[before, j], tops[i, j]), tops[after, j])
                out[3, i, j] = rise[i, j] > low and top <= high
    return np.asarray(out)


def interpolation_weights(values: Array, knots: Row) -> Array:
    """Return the weights (N, K) of knots in the linear interpolation at values (N,)."""
    ones = np.eye(len(knots))
    return np.column_stack([np.interp(values, knots, one) for one in ones])


@cython.boundscheck(False)
@cython.locals(features=cython.float[:, :, ::1], assessable=cython.uchar[:, ::1])
@cython.locals(constant=cython.double[::1])
@cython.locals(out=cython.double[:, ::1], cause=cython.uchar[:, ::1])
def look_up(
    table: RiskTable, features: Single, assessable: Bytes, constant: Array, out: Array, cause: Bytes
) -> None:
    """Set the risk ``out`` (ny, nx) at the ``assessable`` grid points, and its main ``cause``;
    ``constant``: (C,) constant log odds of each cause."""
    low = cython.declare(cython.double[::1], table.low)
    per = cython.declare(cython.double[::1], table.per)
    last = cython.declare(cython.double[::1], table.last)
    terms = cython.declare(cython.int[:, ::1], table.terms)
    tables = cython.declare(cython.float[::1], table.tables)
    exps = cython.declare(cython.double[::1], table.exp_table)
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, t=cython.Py_ssize_t)
    cython.declare(c=cython.Py_ssize_t, f=cython.Py_ssize_t, k=cython.Py_ssize_t)
    cython.declare(first=cython.Py_ssize_t, after=cython.Py_ssize_t)
    columns: cython.Py_ssize_t = out.shape[1]
    causes: cython.Py_ssize_t = constant.shape[0]
    count: cython.Py_ssize_t = features.shape[0]
    entry = cython.declare(cython.int[:, ::1], np.zeros((count, columns), dtype=np.int32))
    row_start = cython.declare(cython.int[::1], np.zeros(columns, dtype=np.int32))
    odds = cython.declare(cython.double[:, ::1], np.zeros((causes, columns)))
    least: cython.double = MIN_ODDS
    end: cython.double = EXP_ENTRIES - 1
    step: cython.double = (EXP_ENTRIES - 1) / (MAX_ODDS - MIN_ODDS)
    with cython.nogil:
        for i in range(out.shape[0]):
            first, after = 0, columns
            while first < after and not assessable[i, first]:
                first += 1
            while after > first and not assessable[i, after - 1]:
                after -= 1
            for f in range(count):
                base: cython.double = low[f]
                scale: cython.double = per[f]
                top: cython.double = last[f]
                for j in range(first, after):
                    x: cython.double = (features[f, i, j] - base) * scale + 0.5
                    x = x if x > 0.0 else 0.0  # also for NaN
                    x = x if x < top else top
                    entry[f, j] = cython.cast(cython.int, x)
            for j in range(first, after):
                row_start[j] = CURVE_ENTRIES * entry[DENSITY, j]
            for c in range(causes):
                for j in range(first, after):
                    odds[c, j] = constant[c]
            for t in range(terms.shape[0]):
                c, f, k = terms[t, 0], terms[t, 1], terms[t, 2]
                if terms[t, 3]:
                    for j in range(first, after):
                        odds[c, j] += tables[k + row_start[j] + entry[f, j]]
                else:
                    for j in range(first, after):
                        odds[c, j] += tables[k + entry[f, j]]
            for j in range(first, after):
                if not assessable[i, j]:
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
@cython.locals(values=cython.float[:, :, ::1])
def square_means(values: Single, reach: cython.Py_ssize_t) -> Single:
    """Average values of finest cells (F, n, n) over the part inside the domain of the square of
    2 ``reach`` x 2 ``reach`` cells about each grid point; returns (F, n + 1, n + 1)."""
    cython.declare(f=cython.Py_ssize_t, i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    n: cython.Py_ssize_t = values.shape[1]
    share: cython.double = 1.0 / (2 * reach)
    means = np.empty((values.shape[0], n + 1, n + 1), dtype=np.float32)
    out = cython.declare(cython.float[:, :, ::1], means)
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
    point = np.arange(n + 1)
    inside = (np.minimum(point + reach, n) - np.maximum(point - reach, 0)) / (2.0 * reach)
    means /= np.outer(inside, inside)
    return means
