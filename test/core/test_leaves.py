# SPDX-License-Identifier: Apache-2.0
"""The tree as a table: leaves tile the domain, lookup agrees with descent, bounds hold."""

import numpy as np
import pytest
from core.builders import configured, divide, look, mapped
from core.kernels import shifted
from core.scenes import flat
from hypothesis import given, settings
from hypothesis import strategies as st

from quadtree_lss.onboard.core.geometry import morton
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.tree.checkpoint import to_bytes
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.core.tree.leaves import LeafTable

DOMAIN = Domain(-3.0, 5.0, 16.0, 1, 5)


def places(tree: LeafTable) -> list[np.ndarray]:
    """Level, ix and iy of the leaves."""
    return [tree.rows[name][: tree.count] for name in ("level", "ix", "iy")]


def raster_of(tree: LeafTable) -> np.ndarray:
    """(n, n) [iy, ix] row of the leaf over each finest cell."""
    spread = morton.SPREAD[: tree.domain.finest_count]
    return tree.leaf_of[spread | spread[:, None] << 1]


def grown(domain: Domain, seed: int, rounds: int = 6, max_cells: int = 100_000) -> LeafTable:
    """A tree divided at random leaves."""
    rng = np.random.default_rng(seed)
    tree = LeafTable(domain, max_cells)
    for _ in range(rounds):
        open_ = np.flatnonzero(places(tree)[0] < domain.max_level)
        for row in rng.permutation(open_)[: max(len(open_) // 3, 1)].tolist():
            divide(tree, row)
    return tree


def assert_tiles(domain: Domain, level: np.ndarray, ix: np.ndarray, iy: np.ndarray) -> None:
    """Every finest cell lies under exactly one leaf."""
    n = domain.finest_count
    covered = np.zeros((n, n), dtype=int)
    for depth, column, row in zip(level.tolist(), ix.tolist(), iy.tolist(), strict=True):
        side = 1 << (domain.max_level - depth)
        covered[row * side : (row + 1) * side, column * side : (column + 1) * side] += 1
    assert (covered == 1).all()


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.integers(0, 3), st.integers(0, 3), st.integers(0, 8))
def test_leaves_tile_the_domain_and_lookup_agrees_with_descent(seed, low, more, rounds):
    domain = Domain(-3.0, 5.0, 16.0, low, low + more)
    tree = grown(domain, seed, rounds)
    level, ix, iy = places(tree)
    assert_tiles(domain, level, ix, iy)
    assert level.min() >= domain.min_level
    assert level.max() <= domain.max_level
    found = raster_of(tree)
    row, column = np.indices(found.shape)
    down = domain.max_level - level[found].astype(int)
    np.testing.assert_array_equal(column >> down, ix[found])
    np.testing.assert_array_equal(row >> down, iy[found])


def test_centres_are_in_the_middle_of_their_finest_cells():
    tree = grown(DOMAIN, 1)
    leaf = raster_of(tree)
    middle = (np.arange(DOMAIN.finest_count) + 0.5) * DOMAIN.finest_size
    for k in range(tree.count):
        rows, columns = np.nonzero(leaf == k)
        assert tree.rows.x[k] == pytest.approx(DOMAIN.xmin + middle[columns].mean(), abs=1e-12)
        assert tree.rows.y[k] == pytest.approx(DOMAIN.ymin + middle[rows].mean(), abs=1e-12)


@pytest.mark.parametrize("max_cells", [4, 6, 7, 12, 40])
def test_the_number_of_cells_is_bounded(max_cells):
    tree = LeafTable(DOMAIN, max_cells)
    for _ in range(8):
        for row in np.flatnonzero(places(tree)[0] < DOMAIN.max_level).tolist():
            before = tree.count
            assert divide(tree, row) == (before + 3 <= max_cells)
            assert tree.count - before in (0, 3)
    assert max_cells - 3 < tree.count <= max_cells
    assert_tiles(DOMAIN, *places(tree))


def known_leaf(domain: Domain) -> LeafTable:
    """One leaf with a steep, well-known plane."""
    tree = LeafTable(domain, 1000)
    leaf = tree.rows[0]
    leaf.state, leaf.z = 3, 2.0
    leaf.normal[:] = np.array([0.3, -0.2, 1.0]) / np.sqrt(1.13)
    leaf.range_part[:] = np.diag([1e-4, 2e-4, 1e-3]).ravel()
    leaf.pose_part[:] = np.diag([2e-4, 1e-4, 4e-3]).ravel()
    return tree


def test_inherited_planes_are_the_parents():
    """Children see the same plane about their own centre: by a change of origin, no more."""
    tree = known_leaf(Domain(0.0, 0.0, 8.0, 0, 4))
    parent = tree.rows[0].copy()
    assert divide(tree, 0)
    assert tree.count == 4
    for child in tree.rows[:4]:
        assert child.state == 2
        off = np.array([child.x - parent.x, child.y - parent.y, child.z - parent.z])
        assert parent.normal @ off == pytest.approx(0.0, abs=1e-12)
        np.testing.assert_array_equal(child.normal, parent.normal)
        for name in ("range_part", "pose_part"):
            expected = shifted(parent[name].reshape(3, 3), parent.normal, off)
            np.testing.assert_allclose(child[name].reshape(3, 3), expected, atol=1e-15)


def test_where_a_return_stood_out_the_child_is_less_certain_and_the_ground_not_known():
    """By the greatest distance; the other children and finest cells stay as they were."""
    plain, rough = (known_leaf(Domain(0.0, 0.0, 8.0, 0, 4)) for _ in range(2))
    rough.rows[0].greatest = 0.5
    rough.observed[:] = 2
    rough.observed[morton.encode(11, 3)] = 3
    for tree in (plain, rough):
        divide(tree, 0)
    added = (rough.rows.range_part - plain.rows.range_part)[:4]
    np.testing.assert_allclose(added, np.outer([0.0, 1.0, 0.0, 0.0], [0.0] * 8 + [0.25]))
    seen = np.full(256, 2)
    seen[morton.encode(11, 3)] = 1
    np.testing.assert_array_equal(rough.observed, seen)


def test_bounded_cells_are_refused_counted_and_leave_no_hole():
    rng, mapper = np.random.default_rng(6), Mapper(configured(mapping={"max_cells": 40}))
    x, y = 16.0 * rng.random((2, 20_000))
    report = look(mapper, lambda x, y: 0.5 * np.sin(4.0 * x), x, y, rng, 0.06)
    assert report.leaves <= 40
    assert report.refused_divisions > 0
    cells = mapper.snapshot()
    assert_tiles(cells.domain, cells.level, cells.ix, cells.iy)
    assert cells.estimated.all()


def test_reset_is_as_new():
    config = configured()
    used = mapped(config, lambda x, y: 0.5 * (x > 5.0), density=30.0)
    assert used.leaves.count > 16
    used.reset()
    new = Mapper(config)
    x, y = 16.0 * np.random.default_rng(7).random((2, 4000))
    for _ in range(2):  # as it is, and after what a scan does to it
        assert to_bytes(used.export_state()) == to_bytes(new.export_state())
        for mapper in (used, new):
            look(mapper, flat(), x, y, np.random.default_rng(8), 0.05)
