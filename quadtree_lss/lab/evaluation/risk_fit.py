# SPDX-License-Identifier: Apache-2.0
"""Fit a ``RiskModel`` to features of grid points and the failures of landings there.

The log odds of each cause are a constant plus steps between the knots of its curves. The steps of
most curves have one sign, so that for example a larger rise never reduces the risk.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import ArrayLike
from scipy.optimize import Bounds, minimize
from scipy.special import expit

from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.config.risk import CAUSES, LOCAL, OVERALL, Cause, Curve, RiskModel, Row
from quadtree_lss.onboard.core.landing.risk import interpolation_weights

#: Names of the features, in order.
FEATURES = LOCAL + OVERALL
#: Knots of the feature ``seen`` for curves that have a row for each.
SEEN = (0.0, 1.2, 2.2)
#: Weight of the squared steps relative to the mean log score.
RIDGE = 3e-7
SOLVER_OPTIONS = {"maxiter": 2000, "maxfun": 3000, "maxcor": 40, "ftol": 1e-12, "gtol": 1e-7}


class Term(NamedTuple):
    """A curve to fit: its feature, the sign of its steps (0 for any), whether it has a row for each
    knot of `SEEN`, and the initial log odds at its end over its start."""

    of: str
    knots: Row
    sign: int = 1
    by_seen: bool = False
    begin: float = 0.1

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and steps."""
        return len(SEEN) if self.by_seen else 1, len(self.knots) - 1


_CONTACT = (0.4, 0.6, 0.8, 0.9, 1.0, 1.15, 1.5)
_CELL, _NOISE = (-0.2, 0.0, 0.15, 0.35), (-1.2, -0.8, -0.35)
_RELIEF = (0.0, 0.05, 0.1, 0.2, 0.35, 0.6)
TERMS: dict[str, tuple[Term, ...]] = {
    "obstacle": (
        Term("rise", _CONTACT, by_seen=True, begin=5.5),
        Term("rise_beside", _CONTACT, by_seen=True, begin=5.5),
        Term("relief", _RELIEF),
        Term("noise", _NOISE, 0),
        Term("cell", _CELL, 0),
    ),
    "slope": (
        Term("tilt", _CONTACT[:-1], by_seen=True, begin=5.5),
        Term("tilt_beside", _CONTACT[:-1], by_seen=True, begin=5.5),
        Term("gradient", _CONTACT[:-1], by_seen=True),
        Term("relief", _RELIEF),
        Term("noise", _NOISE, 0),
    ),
    "hidden": (
        Term("seen", (-1.5, -0.5, 0.2, 0.6, 1.0, 1.4, 1.8, 2.2, 2.6), -1, begin=-5.5),
        Term("relief", _RELIEF),
        Term("roughness", (0.0, 0.07, 0.15, 0.3, 0.5)),
        Term("abundance", (-4.0, -3.3, -2.6, -2.0, -1.5, -1.0)),
        Term("noise", _NOISE, 0),
        Term("cell", _CELL, 0),
        Term("clearance", (-1.25, -1.1, -0.95, -0.78), 0),
        Term("lean", (-0.35, -0.1, 0.15, 0.45), -1, begin=-0.5),
    ),
}


def fit(places: Array, failed: Mask, weight: Array) -> RiskModel:
    """Fit a model by maximum likelihood to features (K, len(FEATURES)), failures (K,) and weights
    (K,) of landings."""
    columns = [_columns(places, terms) for terms in TERMS.values()]
    ends = np.cumsum([part.shape[1] for part in columns])
    begin = np.concatenate([_steps(unfitted().causes[name]) for name in CAUSES])
    signs: list[float] = []
    for terms in TERMS.values():
        signs += [0.0, *(t.sign for t in terms for _ in range(np.prod(t.shape)))]
    sign = np.array(signs)
    ridge = np.full(len(begin), RIDGE)
    ridge[[0, *ends[:-1]]] = 0.0  # the constants
    weight, fails = weight / weight.sum(), np.asarray(failed, np.float64)

    def score(steps: Array) -> tuple[float, Array]:
        """Mean log score with the ridge term, and its gradient."""
        each = zip(columns, np.split(steps, ends[:-1]), strict=True)
        odds = [(part @ own.astype(np.float32)).astype(np.float64) for part, own in each]
        safe = np.minimum(-sum(np.logaddexp(0.0, z) for z in odds), -1e-9)
        risk = -np.expm1(safe)
        value = -np.sum(weight * (fails * np.log(risk) + (1.0 - fails) * safe))
        push = weight * (1.0 - fails / risk)
        each = zip(columns, odds, strict=True)
        slope = np.concatenate([part.T @ (push * expit(z)).astype(np.float32) for part, z in each])
        return float(value + np.sum(ridge * steps**2)), slope + 2.0 * ridge * steps

    bounds = Bounds(np.where(sign > 0, 0.0, -np.inf), np.where(sign < 0, 0.0, np.inf))
    found = minimize(
        score, begin, jac=True, method="L-BFGS-B", bounds=bounds, options=SOLVER_OPTIONS
    )
    return _model(np.split(found.x, ends[:-1]))


def risks(model: RiskModel, given: ArrayLike) -> Array:
    """Risk (K,) at features (K, len(FEATURES))."""
    places = np.asarray(given, np.float64)
    seen = interpolation_weights(places[:, FEATURES.index("seen")], model.seen)
    safe = np.zeros(len(places))
    for cause in model.causes.values():
        odds = np.full(len(places), cause.constant)
        for curve in cause.curves:
            along = interpolation_weights(places[:, FEATURES.index(curve.feature)], curve.knots)
            rows = along @ np.array(curve.odds).T
            odds += rows[:, 0] if len(curve.odds) == 1 else np.sum(rows * seen, axis=1)
        safe -= np.logaddexp(0.0, odds)
    return np.asarray(-np.expm1(safe))


def _columns(places: Array, terms: tuple[Term, ...]) -> Array:
    """Coefficients (K, 1 + steps) of the constant and the steps of a cause."""
    seen = interpolation_weights(places[:, FEATURES.index("seen")], SEEN)
    parts = [np.ones((len(places), 1))]
    for term in terms:
        knots, at = np.array(term.knots), places[:, FEATURES.index(term.of), None]
        steps = np.clip((at - knots[:-1]) / np.diff(knots), 0.0, 1.0)
        if term.by_seen:
            steps = (seen[:, :, None] * steps[:, None]).reshape(len(places), -1)
        parts.append(steps)
    return np.concatenate(parts, axis=1).astype(np.float32)


def unfitted() -> RiskModel:
    """Return the initial model of a fit."""
    begin = {"obstacle": -9.0, "slope": -9.0, "hidden": -2.5}
    causes = {}
    for name, terms in TERMS.items():
        curves = []
        for term in terms:
            row = tuple(np.linspace(0.0, term.begin * bool(term.sign), len(term.knots)).tolist())
            curves.append(Curve(term.of, term.knots, (row,) * term.shape[0]))
        causes[name] = Cause(begin[name], tuple(curves))
    return RiskModel(SEEN, causes)


def _steps(cause: Cause) -> Array:
    return np.concatenate(
        [[cause.constant], *(np.diff(curve.odds, axis=1).ravel() for curve in cause.curves)]
    )


def _model(steps: list[Array]) -> RiskModel:
    causes = {}
    for (name, terms), own in zip(TERMS.items(), steps, strict=True):
        curves, at = [], 1
        for term in terms:
            of = own[at : at + np.prod(term.shape)].reshape(term.shape)
            at += of.size
            odds = np.pad(np.cumsum(of, axis=1), ((0, 0), (1, 0)))
            curves.append(Curve(term.of, term.knots, tuple(rounded(row) for row in odds)))
        causes[name] = Cause(rounded(own[:1])[0], tuple(curves))
    return RiskModel(SEEN, causes)


def rounded(values: Array) -> Row:
    return tuple(round(float(value), 3) for value in values)


def risk_model_text(model: RiskModel) -> str:
    """Format a model as YAML for `risk_model`."""
    content: dict[str, Any] = {"seen": list(model.seen)}
    for name, cause in model.causes.items():
        curves = {
            c.feature: {"knots": list(c.knots), "odds": [*map(list, c.odds)]} for c in cause.curves
        }
        content[name] = {"constant": cause.constant, **curves}
    content["provenance"] = dict(model.provenance)
    return str(yaml.safe_dump(content, sort_keys=False, width=96, default_flow_style=None))
