# SPDX-License-Identifier: Apache-2.0
"""The sphere S^2: identities, round trips, numeric Jacobians, the errata of Eq. 5 and 9."""

import numpy as np
import pytest
from core import kernels
from core.builders import differentiated, unit_vectors, upward_normals
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

#: Central differences err by 1e-6^2 times a third derivative of order one, and by rounding / 1e-6.
NUMERIC = 1e-8

angles = st.floats(0.0, 3.1)
headings = st.floats(0.0, 2.0 * np.pi)


def tangent(angle: float, heading: float) -> np.ndarray:
    return angle * np.array([np.cos(heading), np.sin(heading)])


@settings(max_examples=200)
@given(angles, headings)
def test_log_undoes_exp(angle, heading):
    phi = tangent(angle, heading)
    n = kernels.exp(phi)
    assert np.linalg.norm(n) == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(kernels.log(n)[0], phi, atol=1e-12)


@pytest.mark.parametrize("most", [0.05, 0.2])
def test_series_of_small_turns_are_right_to_the_last_bit(most):
    """On both sides of where they end, 0.1 and 0.032 rad, against numbers of more digits."""
    for angle in np.random.default_rng(7).uniform(0.0, most, 500):
        exact = np.longdouble(angle)
        found = kernels.exp([angle, 0.0])
        np.testing.assert_allclose(found[0], float(np.sin(exact)), rtol=2.5e-16)
        np.testing.assert_allclose(found[2], float(np.cos(exact)), rtol=2.5e-16)
        # Of the sine alone, which knows the angle to its own last bit.
        sine = np.longdouble(found[0])
        back = kernels.log([found[0], 0.0, found[2]])[0][0]
        np.testing.assert_allclose(back, float(np.arcsin(sine)), rtol=5e-16)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 1e-4, 0.4, 1.5, 1.6, 2.5])
def test_log_jacobian_undoes_the_derivative_of_exp(angle):
    """Erratum of Eq. 5: n.dn = 0 whatever dphi."""
    for heading in np.linspace(0.0, 2.0 * np.pi, 7):
        phi = tangent(angle, heading)
        change = differentiated(lambda step, phi=phi: kernels.exp(phi + step), 2)
        np.testing.assert_allclose(kernels.exp(phi) @ change, 0.0, atol=NUMERIC)
        product = kernels.log(kernels.exp(phi))[1] @ change
        np.testing.assert_allclose(product, np.eye(2), atol=1e-7)


def test_the_tangents_axes_are_those_of_the_shortest_rotation_from_up():
    for n in unit_vectors(np.random.default_rng(3), 200):
        if n[2] > -0.99:
            phi, _ = kernels.log(n)
            # The axis of that rotation is horizontal, across the lean.
            expected = Rotation.from_rotvec([-phi[1], phi[0], 0.0]).as_matrix()
            np.testing.assert_allclose(kernels.tangent_basis(n), expected[:, :2], atol=1e-12)


@settings(max_examples=200)
@given(st.floats(0.0, 1.57), headings, st.floats(0.0, 1.5), headings)
def test_minus_undoes_plus(lean, lean_heading, angle, heading):
    """Within a quarter turn; beyond, -n is the nearer name of the same plane."""
    n = kernels.exp(tangent(lean, lean_heading))
    phi = tangent(angle, heading)
    np.testing.assert_allclose(kernels.minus(kernels.plus(n, phi), n), phi, atol=1e-9)


def test_change_of_tangent_is_the_derivative_of_the_difference():
    rng = np.random.default_rng(12)
    for of, to in zip(upward_normals(rng, 30, 1.4), upward_normals(rng, 30, 1.4), strict=True):
        if of @ to < 0.1:
            continue  # beyond a quarter turn the other name of the plane is nearer
        change = differentiated(lambda e, of=of, to=to: kernels.minus(kernels.plus(of, e), to), 2)
        np.testing.assert_allclose(kernels.tangent_change(of, to), change, atol=1e-7)
