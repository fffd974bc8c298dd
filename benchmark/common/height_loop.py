# SPDX-License-Identifier: Apache-2.0
"""The simplest terrain map: mean heights in a loop. `heights.py` compiles it."""

import cython


@cython.boundscheck(False)
@cython.wraparound(False)
@cython.cdivision(True)
def mean_heights(
    points: cython.double[:, ::1],
    rotation: cython.double[:, ::1],
    position: cython.double[::1],
    xmin: cython.double,
    ymin: cython.double,
    size: cython.double,
    count: cython.double[:, ::1],
    mean: cython.double[:, ::1],
) -> None:
    """Mean height of the points (N, 3), lidar axes, in each cell of a square grid, m.

    Fill ``count`` and ``mean`` (n, n) [iy, ix]; ``mean`` is 0 in cells without points.
    """
    n: cython.Py_ssize_t = count.shape[0]
    i: cython.Py_ssize_t
    k: cython.Py_ssize_t
    ix: cython.Py_ssize_t
    iy: cython.Py_ssize_t
    count[:, :] = 0.0
    mean[:, :] = 0.0
    per_metre: cython.double = 1.0 / size
    with cython.nogil:
        for i in range(points.shape[0]):
            px: cython.double = points[i, 0]
            py: cython.double = points[i, 1]
            pz: cython.double = points[i, 2]
            x = rotation[0, 0] * px + rotation[0, 1] * py + rotation[0, 2] * pz + position[0]
            y = rotation[1, 0] * px + rotation[1, 1] * py + rotation[1, 2] * pz + position[1]
            z = rotation[2, 0] * px + rotation[2, 1] * py + rotation[2, 2] * pz + position[2]
            x = (x - xmin) * per_metre
            y = (y - ymin) * per_metre
            if 0.0 <= x < n and 0.0 <= y < n:  # false for no return, which is NaN
                ix = cython.cast(cython.Py_ssize_t, x)
                iy = cython.cast(cython.Py_ssize_t, y)
                count[iy, ix] += 1.0
                mean[iy, ix] += z
        for i in range(n):
            for k in range(n):
                if count[i, k] > 0.0:
                    mean[i, k] /= count[i, k]
