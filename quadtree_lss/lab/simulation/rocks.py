# SPDX-License-Identifier: Apache-2.0
"""Rocks on the posts of a field, compiled: half-buried ellipsoids, single or in heaps."""

from __future__ import annotations

import cython
from cython.cimports.libc.math import sqrt

from quadtree_lss.onboard.arrays import Array, Index


@cython.boundscheck(False)
@cython.locals(rocks=cython.double[:, ::1], axis=cython.double[::1])
@cython.locals(posts=cython.Py_ssize_t[:, ::1], stones=cython.double[:, ::1])
def add_rocks(rocks: Array, axis: Array, posts: Index, stones: Array, heaped: cython.bint) -> None:
    """Raise the posts under each rock to its surface if that is higher.

    Args:
        rocks: (n, n) heights of rocks over the ground, changed in place, m.
        axis: (n,) coordinates of the posts, m.
        posts: (K, 4) first row, row after the last, and likewise columns, of each rock.
        stones: (K, 7) x, y, height, half axes, cosine and sine of the longer one's heading.
        heaped: Whether each rock lies on the rocks below its centre, at 0.6 of their height but
            at most 0.6 m up.
    """
    cython.declare(k=cython.Py_ssize_t, i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    base = 0.0
    with cython.nogil:
        for k in range(stones.shape[0]):
            x, y, height = stones[k, 0], stones[k, 1], stones[k, 2]
            long, short = stones[k, 3], stones[k, 4]
            cos, sin = stones[k, 5], stones[k, 6]
            if heaped and posts[k, 0] < posts[k, 1] and posts[k, 2] < posts[k, 3]:
                i = posts[k, 0] + (posts[k, 1] - posts[k, 0]) // 2
                j = posts[k, 2] + (posts[k, 3] - posts[k, 2]) // 2
                base = min(0.6 * rocks[i, j], 0.6)
            for i in range(posts[k, 0], posts[k, 1]):
                dy = axis[i] - y
                for j in range(posts[k, 2], posts[k, 3]):
                    dx = axis[j] - x
                    along, across = (cos * dx + sin * dy) / long, (cos * dy - sin * dx) / short
                    rise = height * sqrt(max(1.0 - along * along - across * across, 0.0))
                    if rise > 0.0:
                        rocks[i, j] = max(rocks[i, j], base + rise)
