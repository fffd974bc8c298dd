# SPDX-License-Identifier: Apache-2.0
"""Small matrices, lengths and the normal distribution's tail, to the same bits on every processor.

BLAS and LAPACK have code of their own for each processor, and so has the C library's ``hypot``:
sums in another order, products and sums fused or not. Their last bits are those of one computer.
"""

from __future__ import annotations

import cython
import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array

if not cython.compiled:
    from math import exp, fabs, sqrt

#: What a correlation is taken for that is less than this: none.
LEAST = cython.declare(cython.double, 1e-17)
#: Rounds at most; seven do for six rows.
ROUNDS = cython.declare(cython.int, 30)
#: So many deviations out the tail is less than the least number.
FAR = cython.declare(cython.double, 38.5)


def length(x: float, y: float) -> cython.double:
    """sqrt(x^2 + y^2), without overflow."""
    most = max(fabs(x), fabs(y), 1e-300)
    x /= most
    y /= most
    return most * sqrt(x * x + y * y)


def product(one: ArrayLike, other: ArrayLike) -> Array:
    """Of matrices (..., n, k) and (..., k, m), or of a matrix (n, k) and a vector (k,)."""
    a, b = np.asarray(one, dtype=np.float64), np.asarray(other, dtype=np.float64)
    if a.ndim > 2:
        stacked: Array = np.sum(a[..., None] * b[..., None, :, :], axis=-2)
        return stacked
    columns = b if b.ndim == 2 else b[:, None]
    if a.shape[1] != len(columns):
        msg = f"a matrix {a.shape} does not multiply {b.shape}"
        raise ValueError(msg)
    out = np.empty((len(a), columns.shape[1]))
    multiply(a, columns, out)
    return out if b.ndim == 2 else out[:, 0]


@cython.boundscheck(False)
def multiply(a: Array, b: Array, out: Array) -> cython.void:
    """Product (n, m) of (n, k) and (k, m), to ``out``."""
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            total = 0.0
            for k in range(a.shape[1]):
                total += a[i, k] * b[k, j]
            out[i, j] = total


def eigen(matrix: Array) -> tuple[Array, Array]:
    """Eigenvalues (n,), in no order, and unit eigenvectors, the columns of (n, n), by Jacobi's
    method, of a symmetric matrix (n, n), of which what lies above the diagonal is not read."""
    left, vectors = _diagonal(matrix)
    return left.diagonal(), vectors


def limited(matrix: Array, most: float) -> Array:
    """A symmetric matrix (n, n), as `eigen` reads it, with its eigenvalues from 0 to ``most``."""
    left, vectors = _diagonal(matrix)
    a = cython.declare(cython.double[:, ::1], left)
    v = cython.declare(cython.double[:, ::1], vectors)
    scale_columns(v, a, most)
    multiply(v, v.T, a)
    return left


def _diagonal(matrix: Array) -> tuple[Array, Array]:
    """The matrix (n, n) about the axes where it is diagonal, and these axes."""
    left = np.array(matrix, dtype=np.float64, order="C")
    if left.ndim != 2 or left.shape[0] != left.shape[1]:
        msg = f"no square matrix: {left.shape}"
        raise ValueError(msg)
    vectors = np.empty(left.shape)
    diagonalise(left, vectors)
    return left, vectors


@cython.boundscheck(False)
def scale_columns(v: Array, a: Array, most: float) -> cython.void:
    """Each of the columns v (n, n) times the root of its value, on the diagonal of a (n, n), which
    is taken for 0 or ``most`` if it is beyond."""
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    for j in range(v.shape[1]):
        root = sqrt(min(max(a[j, j], 0.0), most))
        for i in range(v.shape[0]):
            v[i, j] *= root


@cython.boundscheck(False)
def diagonalise(a: Array, v: Array) -> cython.void:
    """Turn the axes of a symmetric matrix (n, n) until it is diagonal; v (n, n): where to."""
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
    turns: cython.int = 1
    for i in range(a.shape[0]):
        for j in range(a.shape[0]):
            v[i, j] = 1.0 if i == j else 0.0
            a[i, j] = a[max(i, j), min(i, j)]
    for _ in range(ROUNDS):
        if turns == 0:
            break
        turns = 0
        for i in range(1, a.shape[0]):
            for j in range(i):
                both = a[i, j]
                if fabs(both) <= LEAST * sqrt(fabs(a[i, i])) * sqrt(fabs(a[j, j])):
                    continue
                turns += 1
                # Of the angles that make this element vanish, the one below 45 degrees.
                half = 0.5 * (a[j, j] - a[i, i])
                tangent = both / (fabs(half) + length(half, both))
                if half < 0.0:
                    tangent = -tangent
                c = 1.0 / sqrt(1.0 + tangent * tangent)
                s = tangent * c
                for k in range(a.shape[0]):
                    x = v[k, i]
                    v[k, i] = c * x - s * v[k, j]
                    v[k, j] = s * x + c * v[k, j]
                    if k != i and k != j:
                        x = a[k, i]
                        a[k, i] = a[i, k] = c * x - s * a[k, j]
                        a[k, j] = a[j, k] = s * x + c * a[k, j]
                a[i, i] -= tangent * both
                a[j, j] += tangent * both
                a[i, j] = a[j, i] = 0.0


def above(deviations: float) -> cython.double:
    """P(N(0, 1) > deviations), to a relative 3e-15 up to six deviations, 1e-13 beyond.

    Without the C library's ``erfc``, which fuses products and sums where the processor can:
    exp(-x^2 / 2) times the ratio of two polynomials in x, fitted to exp(x^2 / 2) P(N(0, 1) > x)
    over x >= 0 for the least greatest relative error, 4e-16. All of their terms are positive.
    """
    x = fabs(deviations)
    if x >= FAR:
        return 0.0 if deviations > 0.0 else 1.0
    over = 4.935102247533579e-05 + x * 1.940160298828003e-06
    over = 0.004972004988295803 + x * (0.0006205945575359533 + x * over)
    over = 0.11085399056893214 + x * (0.0277063276120961 + x * over)
    over = 0.6338500637350406 + x * (0.31819811776052176 + x * over)
    over = 0.5 + x * (0.8018813915680824 + x * over)
    under = 0.00012370466831862175 + x * 4.863260662358805e-06
    under = 0.012586672953265831 + x * (0.0015604631256661244 + x * under)
    under = 0.2900853047594523 + x * (0.07099533754870209 + x * under)
    under = 1.8430063482387424 + x * (0.8639913388908103 + x * under)
    under = 2.401647343938967 + x * (2.683937463694092 + x * under)
    tail = exp(-0.5 * x * x) * over / (1.0 + x * under)
    return tail if deviations > 0.0 else 1.0 - tail
