# SPDX-License-Identifier: Apache-2.0
"""Planes of higher levels, fused from the leaves below them (paper IV.B, IV.C)."""

from __future__ import annotations

from collections.abc import MutableSequence
from dataclasses import dataclass
from typing import TypeAlias

import cython
import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core.tree.cell_map import CellMap

if not cython.compiled:
    from math import atan2, cos, sin, sqrt

    fmax = max

Array = NDArray[np.float64]
Index = NDArray[np.intp]
#: A C array of doubles that a kernel reads or writes in place.
Vector: TypeAlias = MutableSequence[float]

#: A map of elevations has no walls: steeper planes are tilted back to this n_z (87 deg).
MIN_UP = cython.declare(cython.double, 0.05)


@dataclass(frozen=True)
class Ancestors:
    """Fused planes of the cells of one level that have a measured leaf below them.

    Attributes:
        level: Their level.
        cell: (A,) iy * 2^level + ix.
        x, y, z: (A,) plane's elevation z above the cell's centre, m.
        normal: (A, 3).
        range_part, pose_part: (A, 3, 3) covariance of (dphi_1, dphi_2, dd), d about (x, y, z).
        of_leaf: (M,) place of each leaf's ancestor, -1 where there is none (the leaf is of a
            higher level, or nothing below the ancestor was measured).
    """

    level: int
    cell: Index
    x: Array
    y: Array
    z: Array
    normal: Array
    range_part: Array
    pose_part: Array
    of_leaf: Index


def fuse_to_level(cells: CellMap, level: int) -> Ancestors:
    """Fuse leaves to their ancestors of ``level`` by Eq. 39-45.

    Each leaf's plane is moved to the ancestor's centre (exactly, value and covariance) and
    observes it. Range noise is independent between leaves, so the range parts weigh and average:
    E = (sum R_i^-1)^-1 sum R_i^-1 E_i. Pose error is shared, so it enters once: the mean of the
    leaves' pose parts, weighted by their measurements. Inherited planes are no information.
    Fusing children of children at once is the same as level by level, information being additive.
    """
    n = 1 << level
    below = cells.level >= level
    down = np.where(below, cells.level.astype(np.intp) - level, 0)
    key = (cells.iy.astype(np.intp) >> down) * n + (cells.ix.astype(np.intp) >> down)
    key[~below] = 0
    chosen = np.flatnonzero(below & cells.measured)
    place = np.full(n * n, -1, dtype=np.intp)
    place[key[chosen]] = 0
    cell = np.flatnonzero(place == 0)
    place[cell] = np.arange(len(cell))
    size = float(cells.domain.cell_size(level))
    out = Ancestors(
        level=level,
        cell=cell,
        x=np.asarray(cells.domain.xmin + (cell % n + 0.5) * size, dtype=np.float64),
        y=np.asarray(cells.domain.ymin + (cell // n + 0.5) * size, dtype=np.float64),
        z=np.zeros(len(cell)),
        normal=np.zeros((len(cell), 3)),
        range_part=np.zeros((len(cell), 3, 3)),
        pose_part=np.zeros((len(cell), 3, 3)),
        of_leaf=np.where(below, place[key], -1),
    )
    fuse_leaves(
        out.of_leaf[chosen],
        np.column_stack([cells.x[chosen], cells.y[chosen], cells.z[chosen]]),
        cells.normal[chosen],
        cells.covariance_range[chosen],
        cells.covariance_pose[chosen],
        np.maximum(cells.count[chosen].astype(np.float64), 1.0),
        np.column_stack([out.x, out.y]),
        out.z,
        out.normal,
        out.range_part,
        out.pose_part,
    )
    return out


@cython.boundscheck(False)
def fuse_leaves(
    ancestor: Index,
    centre: Array,
    normal: Array,
    range_part: Array,
    pose_part: Array,
    weight: Array,
    place: Array,
    z: Array,
    fused: Array,
    fused_range: Array,
    fused_pose: Array,
) -> None:
    """Fuse leaves (K) into their ancestors (A); what is fused is zero before.

    Args:
        ancestor: (K,) of each leaf, 0 .. A - 1.
        centre: (K, 3) on each leaf's plane, m.
        normal, range_part, pose_part: (K, 3), (K, 3, 3), (K, 3, 3).
        weight: (K,) measurements.
        place: (A, 2) x and y of the ancestors' centres, m.
        z, fused, fused_range, fused_pose: What is made of them: (A,), (A, 3), (A, 3, 3) twice.
    """
    k: cython.Py_ssize_t
    a: cython.Py_ssize_t
    i: cython.Py_ssize_t
    j: cython.Py_ssize_t
    leaves: cython.Py_ssize_t = ancestor.shape[0]
    count: cython.Py_ssize_t = place.shape[0]
    total = cython.declare(cython.double[::1], np.zeros(count))
    pulled = cython.declare(cython.double[:, ::1], np.zeros((count, 3)))
    reference = cython.declare(cython.double[:, ::1], np.zeros((count, 3)))
    n = cython.declare(cython.double[3])
    arm = cython.declare(cython.double[3])
    error = cython.declare(cython.double[3])
    change = cython.declare(cython.double[9])
    moved = cython.declare(cython.double[9])
    inverse = cython.declare(cython.double[9])
    with cython.nogil:
        for k in range(leaves):
            a = ancestor[k]
            total[a] += weight[k]
            z[a] += weight[k] * centre[k, 2]
            for i in range(3):
                reference[a, i] += weight[k] * normal[k, i]
        for a in range(count):
            z[a] /= total[a]
            norm = 0.0
            for i in range(3):
                norm += reference[a, i] * reference[a, i]
            for i in range(3):
                reference[a, i] /= sqrt(norm)
        for k in range(leaves):
            a = ancestor[k]
            arm[0], arm[1] = place[a, 0] - centre[k, 0], place[a, 1] - centre[k, 1]
            arm[2] = z[a] - centre[k, 2]
            see_from(
                cython.address(normal[k, 0]), arm, cython.address(reference[a, 0]), change, error
            )
            congruent(change, cython.address(range_part[k, 0, 0]), moved)
            invert(moved, inverse)
            for i in range(3):
                for j in range(3):
                    fused_range[a, i, j] += inverse[3 * i + j]
                    pulled[a, i] += inverse[3 * i + j] * error[j]
            congruent(change, cython.address(pose_part[k, 0, 0]), moved)
            for i in range(3):
                for j in range(3):
                    fused_pose[a, i, j] += weight[k] / total[a] * moved[3 * i + j]
        for a in range(count):
            invert(cython.address(fused_range[a, 0, 0]), inverse)
            for i in range(3):
                error[i] = 0.0
                for j in range(3):
                    error[i] += inverse[3 * i + j] * pulled[a, j]
            step_from(cython.address(reference[a, 0]), error, n)
            # d / n_z is how far the plane passes above the origin; the origin moves up to it.
            rise = error[2] / n[2]
            z[a] += rise
            for i in range(9):
                change[i] = 1.0 if i % 4 == 0 else 0.0
            change[6], change[7] = rise * n[0], rise * n[1]
            congruent(change, inverse, cython.address(fused_range[a, 0, 0]))
            for i in range(9):
                moved[i] = fused_pose[a, i // 3, i % 3]
            congruent(change, moved, cython.address(fused_pose[a, 0, 0]))
            for i in range(3):
                fused[a, i] = n[i]


def see_from(normal: Vector, arm: Vector, reference: Vector, change: Vector, error: Vector) -> None:
    """A plane as an observation of one with the normal ``reference`` whose origin lies elsewhere.

    d' = d - n.arm and dd' = dd - (B^T arm).dphi (B the first two columns of Eq. 2 at n); with
    w = R^T n, R that of Eq. 2 at the reference, n [-] reference is log(w) (Eq. 9) and its error
    dlog(w) R^T B dphi.

    Args:
        normal: (3,) of the plane, which passes through its origin.
        arm: (3,) of the other origin from its own, m.
        reference: (3,).
        change: (3, 3), set to the linear map of the plane's error.
        error: (3,), set to (n [-] reference, d').
    """
    i: cython.Py_ssize_t
    j: cython.Py_ssize_t
    own = cython.declare(cython.double[9])
    other = cython.declare(cython.double[9])
    seen = cython.declare(cython.double[3])
    log = cython.declare(cython.double[6])
    turned = cython.declare(cython.double[6])
    axes(normal, own)
    axes(reference, other)
    for i in range(3):
        seen[i] = dot(cython.address(other[3 * i]), normal)
        for j in range(2):
            turned[2 * i + j] = dot(cython.address(other[3 * i]), cython.address(own[3 * j]))
    sine = sqrt(seen[0] * seen[0] + seen[1] * seen[1])
    kx, ky, across = 1.0, 0.0, 1.0
    if sine > 1e-9:
        kx, ky, across = seen[0] / sine, seen[1] / sine, atan2(sine, seen[2]) / sine
    cosine = seen[2]
    log[0], log[4] = cosine * kx * kx + across * ky * ky, cosine * ky * ky + across * kx * kx
    log[1] = log[3] = (cosine - across) * kx * ky
    log[2], log[5] = -sine * kx, -sine * ky
    for i in range(2):
        for j in range(2):
            change[3 * i + j] = (
                log[3 * i] * turned[j]
                + log[3 * i + 1] * turned[2 + j]
                + log[3 * i + 2] * turned[4 + j]
            )
        change[3 * i + 2] = 0.0
        change[6 + i] = -dot(cython.address(own[3 * i]), arm)
    change[8] = 1.0
    error[0], error[1], error[2] = across * seen[0], across * seen[1], -dot(normal, arm)


def step_from(reference: Vector, step: Vector, normal: Vector) -> None:
    """Eq. 8: normal = reference [+] (step[0], step[1]), turned up and no wall."""
    i: cython.Py_ssize_t
    to = cython.declare(cython.double[9])
    axes(reference, to)
    angle = sqrt(step[0] * step[0] + step[1] * step[1])
    sinc = sin(angle) / angle if angle > 1e-9 else 1.0
    for i in range(3):
        normal[i] = (to[i] * step[0] + to[3 + i] * step[1]) * sinc + to[6 + i] * cos(angle)
    if normal[2] < 0.0:
        normal[0], normal[1], normal[2] = -normal[0], -normal[1], -normal[2]
    if normal[2] < MIN_UP:
        level = sqrt((1.0 - MIN_UP * MIN_UP) / (normal[0] * normal[0] + normal[1] * normal[1]))
        normal[0], normal[1], normal[2] = level * normal[0], level * normal[1], MIN_UP


def axes(normal: Vector, out: Vector) -> None:
    """Columns of Eq. 2, the axes of dphi and the normal, as rows of (3, 3)."""
    x, y, z = normal[0], normal[1], normal[2]
    f = 1.0 / (1.0 + z)
    out[0], out[1], out[2] = 1.0 - f * x * x, -f * x * y, -x
    out[3], out[4], out[5] = -f * x * y, 1.0 - f * y * y, -y
    out[6], out[7], out[8] = x, y, z


def dot(a: Vector, b: Vector) -> float:
    """Of two vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def congruent(change: Vector, covariance: Vector, out: Vector) -> None:
    """T C T^T of (3, 3), C symmetric; ``out`` is another array."""
    i: cython.Py_ssize_t
    j: cython.Py_ssize_t
    image = cython.declare(cython.double[9])
    for i in range(3):
        for j in range(3):
            image[3 * i + j] = dot(cython.address(change[3 * i]), cython.address(covariance[3 * j]))
    for i in range(3):
        for j in range(i, 3):
            value = dot(cython.address(image[3 * i]), cython.address(change[3 * j]))
            out[3 * i + j] = out[3 * j + i] = value


def invert(matrix: Vector, out: Vector) -> None:
    """Inverse of a symmetric positive definite (3, 3) by cofactors, scaled to a unit diagonal.

    A scaled determinant below 1e-14 is round-off and taken as that: metres and radians of very
    different size do not spoil the inverse, and a singular matrix gives a large finite one.
    """
    i: cython.Py_ssize_t
    j: cython.Py_ssize_t
    scale = cython.declare(cython.double[3])
    for i in range(3):
        scale[i] = 1.0 / sqrt(fmax(matrix[4 * i], 1e-24))
    b = bounded(matrix[1] * scale[0] * scale[1])
    c = bounded(matrix[2] * scale[0] * scale[2])
    e = bounded(matrix[5] * scale[1] * scale[2])
    out[0], out[4], out[8] = 1.0 - e * e, 1.0 - c * c, 1.0 - b * b
    out[1] = out[3] = c * e - b
    out[2] = out[6] = b * e - c
    out[5] = out[7] = b * c - e
    determinant = fmax(out[0] + b * out[1] + c * out[2], 1e-14)
    for i in range(3):
        for j in range(3):
            out[3 * i + j] *= scale[i] * scale[j] / determinant


def bounded(correlation: float) -> float:
    """Between -1 and 1."""
    return fmax(-1.0, -fmax(-1.0, -correlation))
