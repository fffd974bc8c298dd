# SPDX-License-Identifier: Apache-2.0
"""Kernels of one vector, one plane, one cell, run from their sources and called with arrays.

Compiled, they take C arrays: only other kernels call them. `test_interpreted` sees to it that their
sources give the same bits.
"""

import importlib
import sys
from collections.abc import Callable
from types import ModuleType
from unittest import mock

import numpy as np
from numpy.typing import ArrayLike

import quadtree_lss.onboard
from quadtree_lss import build

Array = np.ndarray
CORE = "quadtree_lss.onboard.core"


def sources(*names: str) -> list[ModuleType]:
    """Modules of the core as if nothing were compiled, beside those that all others use."""
    compiled = importlib.import_module(CORE)
    finders = [build._Sources(), *sys.meta_path]
    with mock.patch.dict(sys.modules), mock.patch.object(sys, "meta_path", finders):
        for name in [name for name in sys.modules if f"{name}.".startswith(f"{CORE}.")]:
            del sys.modules[name]
        found = [importlib.import_module(f"{CORE}.{name}") for name in names]
    quadtree_lss.onboard.core = compiled
    return found


sphere, plane, measure, division, features, leaves = sources(
    *("geometry.sphere", "geometry.plane"),
    *("mapping.measure", "mapping.division", "mapping.features", "tree.leaves"),
)


def filled(kernel: Callable[..., object], sizes: tuple[int, ...], *given: object) -> list[Array]:
    """Arrays of these sizes, the last arguments of a kernel, as it leaves them."""
    out = [[0.0] * size for size in sizes]
    kernel(*(np.asarray(a).tolist() if np.ndim(a) == 1 else a for a in given), *out)
    return [np.array(values) for values in out]


def tangent_basis(normal: ArrayLike) -> Array:
    """First two columns of Eq. 2: (3,) to (3, 2)."""
    return filled(sphere.basis_at, (6,), normal)[0].reshape(2, 3).T


def exp(tangent: ArrayLike) -> Array:
    """Eq. 3: (2,) to (3,)."""
    return filled(sphere.exp_at, (3,), tangent)[0]


def log(normal: ArrayLike) -> tuple[Array, Array]:
    """Eq. 4 and its derivative by n: (3,) to (2,) and (2, 3)."""
    tangent, jacobian = filled(sphere.log_at, (2, 6), normal)
    return tangent, jacobian.reshape(2, 3)


def plus(normal: ArrayLike, tangent: ArrayLike) -> Array:
    """Eq. 8: (3,), (2,) to (3,)."""
    basis = filled(sphere.basis_at, (6,), normal)[0]
    return filled(sphere.plus_at, (3,), normal, basis, tangent)[0]


def minus(normal: ArrayLike, reference: ArrayLike) -> Array:
    """Eq. 9, n [-] m, both up: (3,), (3,) to (2,)."""
    return filled(sphere.minus_at, (2, 4), normal, reference)[0]


def tangent_change(of: ArrayLike, to: ArrayLike) -> Array:
    """Linear map of errors in the tangent at n to the tangent at m: (3,), (3,) to (2, 2)."""
    return filled(sphere.minus_at, (2, 4), of, to)[1].reshape(2, 2)


def shifted(covariance: Array, normal: ArrayLike, delta: ArrayLike) -> Array:
    """Covariance (3, 3) of a plane after its origin moved by delta (3,), m."""
    c = covariance.ravel().tolist()
    plane.shift_origin(c, *(np.asarray(delta) @ tangent_basis(normal)).tolist(), 1)
    return np.array(c).reshape(3, 3)


def fit(
    rules, points: Array, x: float, y: float, side: float, prior, sigma: Array, z=np.nan, uneven=0.0
):
    """All points (N, 3) fitted in one cell: a record of type `measure.RUN`."""
    runs = np.zeros(1, dtype=measure.RUN).view(np.recarray)
    leaf = leaves.blank().view(np.recarray)[0]
    leaf.x, leaf.y, leaf.z, leaf.normal, leaf.uneven = x, y, z, prior, uneven
    leaf.known = leaves.NOTHING if np.isnan(z) else leaves.MEASURED
    flat, sigma = points.ravel().tolist(), sigma.ravel().tolist()
    measure.measure(rules, leaf, runs[0], flat, len(points), np.zeros(3), sigma, side)
    return runs
