# SPDX-License-Identifier: Apache-2.0
"""Compiled functions of one vector, one plane or one cell, called with arrays.

Only other kernels call these functions. Cython exports those that a ``.pxd`` declares, with their
C types, in ``__pyx_capi__`` of the module.
"""

import ctypes
import importlib
import re
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.core.mapping.measure import RUN
from quadtree_lss.onboard.core.tree.leaves import ESTIMATED, UNKNOWN, blank_leaves

Array = np.ndarray


class Pointer:
    """C argument: the first element of a contiguous array of doubles or of records."""

    @staticmethod
    def from_param(array: Array) -> ctypes.c_void_p:
        assert array.flags.c_contiguous and (array.dtype == np.float64 or array.dtype.names)
        return ctypes.c_void_p(array.ctypes.data)


capsule_name = ctypes.pythonapi.PyCapsule_GetName
capsule_name.restype, capsule_name.argtypes = ctypes.c_char_p, [ctypes.py_object]
capsule_pointer = ctypes.pythonapi.PyCapsule_GetPointer
capsule_pointer.restype = ctypes.c_void_p
capsule_pointer.argtypes = [ctypes.py_object, ctypes.c_char_p]

C_TYPES = {
    "void": None,
    "double": ctypes.c_double,
    "int": ctypes.c_int,
    "Py_ssize_t": ctypes.c_ssize_t,
}


def c_type(text: str) -> object:
    """Type of a result or argument as Cython writes it."""
    if text.startswith("struct __pyx_obj_"):
        return ctypes.py_object
    return Pointer if text.endswith("*") else C_TYPES[text]


class Exported:
    """Compiled functions that a kernel of ``core`` declares for others, as attributes."""

    def __init__(self, name: str) -> None:
        self._capsules = importlib.import_module(f"quadtree_lss.onboard.core.{name}").__pyx_capi__

    def __getattr__(self, name: str) -> Callable[..., object]:
        capsule = self._capsules[name]
        signature = capsule_name(capsule)
        result, arguments = re.fullmatch(r"(\S+) \((.*)\)", signature.decode()).groups()
        function = ctypes.PYFUNCTYPE(c_type(result))(capsule_pointer(capsule, signature))
        function.argtypes = [c_type(argument) for argument in arguments.split(", ")]
        return function


sphere, plane = Exported("geometry.sphere"), Exported("geometry.plane")
measure, division = Exported("mapping.measure"), Exported("mapping.division")
features = Exported("mapping.features")


def plane_parts(*parts: Array) -> Array:
    """`PlaneParts` of a normal (3,) and two covariances (3, 3), which it does not copy."""
    assert all(part.flags.c_contiguous and part.dtype == np.float64 for part in parts)
    names = ("normal", "range_part", "pose_part")
    return np.array([tuple(part.ctypes.data for part in parts)], [(name, "u8") for name in names])


def filled(kernel: Callable[..., object], sizes: tuple[int, ...], *given: object) -> list[Array]:
    """Arrays of these sizes, the last arguments of a kernel, as it leaves them."""
    out = [np.zeros(size) for size in sizes]
    kernel(*(np.array(a, dtype=np.float64) if np.ndim(a) else a for a in given), *out)
    return out


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
    moved = covariance.copy()
    plane.shift_origin(moved, *(np.asarray(delta) @ tangent_basis(normal)), 1)
    return moved


def fit(
    rules, points: Array, x: float, y: float, side: float, prior, sigma: Array, z: float = np.nan
):
    """All points (N, 3) of a lidar that points down, fitted in one cell: a record of `RUN`."""
    run = np.zeros(1, dtype=RUN).view(np.recarray)
    leaf = blank_leaves(0, [0], [0]).view(np.recarray)
    leaf.x, leaf.y, leaf.z, leaf.normal = x, y, z, prior
    leaf.state = UNKNOWN if np.isnan(z) else ESTIMATED
    points = np.ascontiguousarray(points)
    pose = np.concatenate([np.zeros(3), np.ravel(sigma), (0.0, 0.0, -1.0)])
    measure.measure(rules, leaf, run, points, len(points), pose, side)
    return run
