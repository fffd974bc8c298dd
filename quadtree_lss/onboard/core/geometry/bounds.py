# SPDX-License-Identifier: Apache-2.0
"""No plane says more than it saw: its heights lie between the lowest and the highest return.

A plane runs on beyond what was measured, and a steep one soon lies metres off. Whatever takes a
height of a leaf, takes it by this rule; slopes stay the plane's.
"""

from __future__ import annotations

import cython
import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array

#: Heights and lengths of a map are less than this, m, and its other figures than this: squares
#: are numbers then, in a message's single precision, too.
MAX_HEIGHT, MAX_VALUE = 1e7, 1e18
#: Of what a map keeps: returns in a leaf lie beside its plane.
MAX_MAP_HEIGHT = 0.95 * MAX_HEIGHT


@cython.ccall
@cython.exceptval(check=False)
def clamp(z: float, low: float, high: float) -> cython.double:
    """The height nearest to z from low to high; a bound that is NaN is none, and NaN stays."""
    z = low if z < low else z
    return high if z > high else z


def clamp_heights(z: ArrayLike, low: ArrayLike, high: ArrayLike) -> Array:
    """`clamp` of each; shapes broadcast."""
    shape = np.broadcast_shapes(*(np.shape(values) for values in (z, low, high)))
    out = np.empty((3, *shape))
    out[0], out[1], out[2] = z, low, high
    flat = out.reshape(3, -1)
    clamp_in_place(flat[0], flat[1], flat[2])
    return np.asarray(out[0])


@cython.boundscheck(False)
@cython.locals(z=cython.double[::1], low=cython.double[::1], high=cython.double[::1])
def clamp_in_place(z: Array, low: Array, high: Array) -> None:
    """Set heights (K,) to those clamp bounds (K,)."""
    k: cython.Py_ssize_t
    for k in range(z.shape[0]):
        z[k] = clamp(z[k], low[k], high[k])
