# SPDX-License-Identifier: Apache-2.0
"""Arithmetic of its own, where libraries end in other bits on other processors."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import log_ndtr, ndtr

from quadtree_lss.onboard.core.geometry.portable import above, eigen, limited, product


def matrix(seed: int, n: int) -> np.ndarray:
    """A covariance of numbers of very different size, now and then singular."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-5.0, 2.0, (n, 1))
    if seed % 3 == 0:
        root[0] = root[-1]
    return root @ root.T


@given(st.integers(0, 10**6), st.sampled_from([1, 2, 3, 6]))
def test_eigenvectors_are_orthonormal_and_give_the_matrix_back(seed, n):
    whole = matrix(seed, n)
    values, vectors = eigen(np.tril(whole))
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(n), atol=1e-14)
    scale = np.abs(whole).max()
    np.testing.assert_allclose((vectors * values) @ vectors.T, whole, atol=1e-14 * scale)
    np.testing.assert_allclose(np.sort(values), np.linalg.eigvalsh(whole), atol=1e-14 * scale)


def test_of_a_diagonal_matrix_nothing_is_turned():
    values, vectors = eigen(np.diag([3.0, 0.0, 1e-9, -2.0]))
    assert values.tolist() == [3.0, 0.0, 1e-9, -2.0]
    assert np.array_equal(vectors, np.eye(4))


@given(st.floats(-1e300, 1e300), st.floats(-1e300, 1e300), st.floats(-1e300, 1e300))
def test_no_numbers_are_too_large_or_too_small_to_be_turned(a, b, c):
    values, vectors = eigen(np.array([[a, b], [b, c]]))
    assert np.isfinite(vectors).all()
    scale = max(abs(a), abs(b), abs(c))
    np.testing.assert_allclose(values.sum() / 4.0, a / 4.0 + c / 4.0, atol=1e-14 * scale)


@given(st.integers(0, 10**6), st.sampled_from([1, 3, 6]))
def test_eigenvalues_are_limited_and_axes_stay(seed, n):
    values, vectors = eigen(matrix(seed, n) - np.eye(n))
    most = float(np.median(values))
    expected = (vectors * np.clip(values, 0.0, max(most, 0.0))) @ vectors.T
    found = limited((vectors * values) @ vectors.T, max(most, 0.0))
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(values).max())


@pytest.mark.parametrize("bad", [np.zeros(3), np.zeros((2, 3)), np.zeros((3, 2))])
def test_only_square_matrices_have_eigenvalues(bad):
    for of in (eigen, lambda matrix: limited(matrix, 1.0)):
        with pytest.raises(ValueError, match="square"):
            of(bad)


@pytest.mark.parametrize(
    ("one", "other"),
    [((3, 3), (3,)), ((3, 3), (3, 3)), ((6, 6), (6, 6)), ((2, 5), (5, 4)), ((7, 3, 3), (7, 3, 3))],
)
def test_products(one, other):
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=one), rng.normal(size=other)
    np.testing.assert_allclose(product(a, b), a @ b, atol=1e-14)
    turned = np.swapaxes(np.ascontiguousarray(np.swapaxes(a, -1, -2)), -1, -2)
    assert np.array_equal(product(turned, b), product(a, b))


def test_a_stack_is_multiplied_as_each_of_it():
    a, b = np.random.default_rng(2).normal(size=(2, 9, 3, 3))
    assert np.array_equal(product(a, b), [product(x, y) for x, y in zip(a, b, strict=True)])


def test_products_of_what_does_not_fit():
    with pytest.raises(ValueError, match="does not multiply"):
        product(np.zeros((3, 3)), np.zeros(4))


@given(st.floats(-36.0, 36.0))
def test_the_tail_of_the_normal_distribution(x):
    assert above(x) == pytest.approx(ndtr(-x), rel=1e-12)
    assert math.log(above(x)) == pytest.approx(log_ndtr(-x), rel=1e-12, abs=1e-15)


def test_far_out_there_is_no_tail():
    assert (above(math.inf), above(1e300), above(39.0)) == (0.0, 0.0, 0.0)
    assert (above(-math.inf), above(-39.0), above(0.0)) == (1.0, 1.0, 0.5)
    assert math.isnan(above(math.nan))


def test_they_are_the_same_bits_everywhere():
    """Sums, products, quotients and roots alone, in one order: known on any computer."""
    share = [[1.0 / (3 * i + 2 * j + 1) for j in range(6)] for i in range(6)]
    covariance = product(share, np.transpose(share))
    values, vectors = eigen(covariance)
    found = [covariance[5, 4], product(share, vectors)[3, 2], max(values), above(0.3), above(4.1)]
    assert [float(x).hex() for x in found] == [
        "0x1.1ebdb56d6adc5p-6",
        "0x1.0a4df57eae100p-14",
        "0x1.651b4f05553b7p+0",
        "0x1.87423a677e912p-2",
        "0x1.5a93510d1bfbep-16",
    ]
