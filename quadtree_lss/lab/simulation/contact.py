# SPDX-License-Identifier: Apache-2.0
"""Contact of a four-legged lander with the posts of a DEM, compiled; see `safety`."""

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.libc.math import INFINITY, ceil, sqrt

from quadtree_lss.onboard.arrays import Array

#: Posts on the rim of a pad or of the circle count as under it, m.
TOLERANCE = cython.declare(cython.double, 1e-9)


@cython.boundscheck(False)
@cython.locals(elevation=cython.double[:, ::1], frame=cython.double[::1])
@cython.locals(points=cython.double[:, ::1], heading=cython.double[:, ::1])
@cython.locals(worst=cython.double[:, ::1])
def worst_contacts(
    elevation: Array,
    frame: Array,
    points: Array,
    heading: Array,
    radius: float,
    pad_radius: float,
    worst: Array,
) -> None:
    """Fill ``worst`` (K, 2) with the tangent of the steepest resting plane and the largest rise of
    the ground above any of the planes, m, for landers at ``points`` (K, 2), entirely over the DEM.

    ``frame`` (4,): position of the first post and distances between posts, x, y, x, y; ``heading``
    (4 yaws, 2): cosine and sine of the directions of the pads; ``radius``: of their circle.
    """
    cython.declare(k=cython.Py_ssize_t, p=cython.Py_ssize_t, q=cython.Py_ssize_t)
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, r=cython.Py_ssize_t)
    pads: cython.Py_ssize_t = heading.shape[0]
    yaws: cython.Py_ssize_t = pads // 4
    ny: cython.Py_ssize_t = elevation.shape[0]
    nx: cython.Py_ssize_t = elevation.shape[1]
    listed: cython.Py_ssize_t
    dx: cython.double = frame[2]
    dy: cython.double = frame[3]
    across_x: cython.Py_ssize_t = int(2.0 * radius / dx) + 3
    across_y: cython.Py_ssize_t = int(2.0 * radius / dy) + 3
    reach: cython.double = (radius + TOLERANCE) * (radius + TOLERANCE)
    height = cython.declare(cython.double[::1], np.empty(pads))
    # Both planes at every yaw: elevation at the centre and slopes.
    plane = cython.declare(cython.double[:, ::1], np.empty((2 * yaws, 3)))
    # Posts within the circle: offsets from the centre, and height over the pads' mean plane.
    post = cython.declare(cython.double[:, ::1], np.empty((across_x * across_y, 3)))
    with cython.nogil:
        for k in range(points.shape[0]):
            x, y = points[k, 0], points[k, 1]
            mean, tilt_x, tilt_y = 0.0, 0.0, 0.0
            for p in range(pads):
                east, north = x + radius * heading[p, 0], y + radius * heading[p, 1]
                height[p] = z = under_pad(elevation, frame, east, north, pad_radius)
                mean += z / pads
                tilt_x += 2.0 * z * heading[p, 0] / (pads * radius)
                tilt_y += 2.0 * z * heading[p, 1] / (pads * radius)
            steepest, spread = 0.0, -INFINITY
            for p in range(yaws):
                # The diagonal a-c carries the vehicle; b-d is a quarter turn on.
                q = p
                if height[p] + height[p + 2 * yaws] < height[p + yaws] + height[p + 3 * yaws]:
                    q = p + yaws
                a, b = height[q], height[q + yaws]
                c, d = height[(q + 2 * yaws) % pads], height[(q + 3 * yaws) % pads]
                centre, along = 0.5 * (a + c), 0.5 * (a - c) / radius
                for r in range(2):
                    across = ((b - centre) if r == 0 else (centre - d)) / radius
                    slope_x = along * heading[q, 0] - across * heading[q, 1]
                    slope_y = along * heading[q, 1] + across * heading[q, 0]
                    steepest = max(steepest, sqrt(slope_x * slope_x + slope_y * slope_y))
                    # Largest distance below the mean plane within the circle.
                    slope_x, slope_y = slope_x - tilt_x, slope_y - tilt_y
                    below = radius * sqrt(slope_x * slope_x + slope_y * slope_y)
                    spread = max(spread, below + mean - centre)
                    plane[2 * p + r, 0] = centre - mean
                    plane[2 * p + r, 1], plane[2 * p + r, 2] = slope_x, slope_y
            # List the posts; the highest one gives a lower bound of the rise over all planes.
            i = max(first_post(x, radius, frame[0], dx), 0)
            j = max(first_post(y, radius, frame[1], dy), 0)
            listed = 0
            highest, high_x, high_y = -INFINITY, 0.0, 0.0
            for q in range(j, min(j + across_y, ny)):
                offset_y = frame[1] + q * dy - y
                for p in range(i, min(i + across_x, nx)):
                    offset_x = frame[0] + p * dx - x
                    if offset_x * offset_x + offset_y * offset_y > reach:
                        continue
                    z = elevation[q, p] - (mean + tilt_x * offset_x + tilt_y * offset_y)
                    post[listed, 0], post[listed, 1], post[listed, 2] = offset_x, offset_y, z
                    listed += 1
                    if z > highest:
                        highest, high_x, high_y = z, offset_x, offset_y
            rise = -INFINITY
            for p in range(2 * yaws):
                rise = max(
                    rise, highest - plane[p, 0] - plane[p, 1] * high_x - plane[p, 2] * high_y
                )
            for q in range(listed):
                if post[q, 2] + spread + TOLERANCE > rise:
                    for p in range(2 * yaws):
                        z = post[q, 2] - plane[p, 0]
                        rise = max(rise, z - plane[p, 1] * post[q, 0] - plane[p, 2] * post[q, 1])
            worst[k, 0], worst[k, 1] = steepest, rise


@cython.boundscheck(False)
@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(elevation=cython.double[:, ::1], frame=cython.double[::1])
def under_pad(elevation: Array, frame: Array, x: float, y: float, radius: float) -> cython.double:
    """Highest ground under a pad: the posts within its radius and the surface under its centre."""
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    ny: cython.Py_ssize_t = elevation.shape[0]
    nx: cython.Py_ssize_t = elevation.shape[1]
    reach: cython.double = radius + TOLERANCE
    left: cython.Py_ssize_t = max(first_post(x, radius, frame[0], frame[2]), 0)
    u = (x - frame[0]) / frame[2]
    v = (y - frame[1]) / frame[3]
    i = min(max(cython.cast(cython.Py_ssize_t, u), 0), nx - 2)
    j = min(max(cython.cast(cython.Py_ssize_t, v), 0), ny - 2)
    fu, fv = u - i, v - j
    low = elevation[j, i] * (1.0 - fu) + elevation[j, i + 1] * fu
    high = elevation[j + 1, i] * (1.0 - fu) + elevation[j + 1, i + 1] * fu
    highest = low * (1.0 - fv) + high * fv
    for j in range(max(first_post(y, radius, frame[1], frame[3]), 0), ny):
        offset_y = frame[1] + j * frame[3] - y
        if offset_y > reach:
            break
        for i in range(left, nx):
            offset_x = frame[0] + i * frame[2] - x
            if offset_x > reach:
                break
            if offset_x * offset_x + offset_y * offset_y <= reach * reach:
                highest = max(highest, elevation[j, i])
    return highest


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def first_post(place: float, reach: float, origin: float, step: float) -> cython.Py_ssize_t:
    """Index of the first post that can be within ``reach`` of ``place`` along an axis."""
    return cython.cast(cython.Py_ssize_t, ceil((place - reach - TOLERANCE - origin) / step - 1e-7))
