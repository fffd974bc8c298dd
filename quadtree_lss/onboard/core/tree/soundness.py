# SPDX-License-Identifier: Apache-2.0
"""Planes that can be: what comes of a file or a message is looked at before anybody trusts it."""

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.libc.math import fabs, sqrt

from quadtree_lss.onboard.arrays import Array, Bytes, Mask
from quadtree_lss.onboard.core.geometry import bounds

#: The least sigma of a feature, m, and the least n_z of a normal (`geometry.plane.orient_up`).
LEAST_SIGMA = cython.declare(cython.double, 1e-6)
LEAST_UP = cython.declare(cython.double, 1e-3)
MAX_VALUE = cython.declare(cython.double, bounds.MAX_VALUE)
MAX_HEIGHT = cython.declare(cython.double, bounds.MAX_HEIGHT)
#: Round-off of a correlation.
SLACK = cython.declare(cython.double, 1.1)


def sound_planes(
    z: Array, normal: Array, range_part: Array, pose_part: Array, feature: Array
) -> Mask:
    """Whether each of M planes, with its feature, is one that can be.

    Args:
        z: (M,) m.
        normal: (M, 3).
        range_part, pose_part: (M, 3, 3) of the covariance, from range noise and from the poses.
        feature: (M, 5).
    """
    sound = np.empty(len(z), dtype=np.uint8)
    look_through(z, normal, range_part.reshape(-1, 9), pose_part.reshape(-1, 9), feature, sound)
    return sound.view(np.bool_)


@cython.boundscheck(False)
@cython.locals(z=cython.double[:], normal=cython.double[:, :], feature=cython.double[:, :])
@cython.locals(range_part=cython.double[:, :], pose_part=cython.double[:, :])
@cython.locals(sound=cython.uchar[::1])
def look_through(
    z: Array, normal: Array, range_part: Array, pose_part: Array, feature: Array, sound: Bytes
) -> None:
    """`sound_planes`, of parts (M, 9), to ``sound`` (M,)."""
    cython.declare(i=cython.Py_ssize_t, j=cython.int, k=cython.int, there=cython.int)
    deviation = cython.declare(cython.double[3])
    ok: cython.bint
    for i in range(z.shape[0]):
        square = normal[i, 0] * normal[i, 0] + normal[i, 1] * normal[i, 1]
        square += normal[i, 2] * normal[i, 2]
        ok = fabs(square - 1.0) < 1e-6 and normal[i, 2] >= LEAST_UP and fabs(z[i]) < MAX_HEIGHT
        for j in range(3):
            ok = ok and range_part[i, 4 * j] >= 0.0 and pose_part[i, 4 * j] >= 0.0
            deviation[j] = sqrt(fabs(range_part[i, 4 * j] + pose_part[i, 4 * j]))
        # As far as round-off leaves that of each part: none is surer than certain anywhere.
        for j in range(3):
            for k in range(3):
                limit = SLACK * deviation[j] * deviation[k]
                of_range = fabs(range_part[i, 3 * j + k])
                of_pose = fabs(pose_part[i, 3 * j + k])
                ok = ok and of_range < MAX_VALUE and of_pose < MAX_VALUE
                ok = ok and of_range <= limit and of_pose <= limit
        there = 0
        for j in range(5):
            there += feature[i, j] == feature[i, j]
            ok = ok and not fabs(feature[i, j]) >= MAX_HEIGHT
        sound[i] = ok and (there == 0 or there == 5 and feature[i, 4] >= LEAST_SIGMA)
