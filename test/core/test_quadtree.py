# SPDX-License-Identifier: Apache-2.0
"""The tree as a table: leaves tile the domain, lookup agrees with descent, bounds hold."""

from __future__ import annotations

import numpy as np
import pytest
from core.builders import configured, domain_of, flat, leaf_by_descent, make_pose, mapped, scan
from hypothesis import given, settings
from hypothesis import strategies as st
from quadtree_lss.core.tree.quadtree import Quadtree, morton_order

from quadtree_lss.core.mapping.mapper import Mapper
from quadtree_lss.core.tree.domain import Domain
from quadtree_lss.core.tree.leaves import Leaves

DOMAIN = Domain(-3.0, 5.0, 16.0, 1, 5)


def grown(domain: Domain, seed: int, rounds: int = 6, max_cells: int = 100_000) -> Quadtree:
    """A tree divided at random leaves."""
    rng = np.random.default_rng(seed)
    tree = Quadtree(domain, max_cells)
    tree.plant()
    for _ in range(rounds):
        open_ = np.flatnonzero(tree.level[: tree.count] < domain.max_level)
        if len(open_):
            tree.split(rng.permutation(open_)[: max(len(open_) // 3, 1)])
    return tree


def assert_tiles(domain: Domain, level: np.ndarray, ix: np.ndarray, iy: np.ndarray) -> None:
    """Every finest cell lies under exactly one leaf."""
    n = domain.finest_count
    covered = np.zeros((n, n), dtype=int)
    for depth, column, row in zip(level.tolist(), ix.tolist(), iy.tolist(), strict=True):
        side = 1 << (domain.max_level - depth)
        covered[row * side : (row + 1) * side, column * side : (column + 1) * side] += 1
    assert (covered == 1).all()


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000), st.integers(0, 3), st.integers(0, 3), st.integers(0, 8))
def test_leaves_tile_the_domain_and_lookup_agrees_with_descent(seed, low, more, rounds):
    domain = Domain(-3.0, 5.0, 16.0, low, low + more)
    tree = grown(domain, seed, rounds)
    level, ix, iy = (v[: tree.count] for v in (tree.level, tree.ix, tree.iy))
    assert_tiles(domain, level, ix, iy)
    assert level.min() >= domain.min_level
    assert level.max() <= domain.max_level
    found = tree.leaf_of_finest.reshape(domain.finest_count, -1)
    row, column = np.indices(found.shape)
    down = domain.max_level - level[found].astype(int)
    np.testing.assert_array_equal(column >> down, ix[found])
    np.testing.assert_array_equal(row >> down, iy[found])


def test_centres_are_in_the_middle_of_their_finest_cells():
    tree = grown(DOMAIN, 1)
    leaf = tree.leaf_of_finest.reshape(DOMAIN.finest_count, -1)
    middle = (np.arange(DOMAIN.finest_count) + 0.5) * DOMAIN.finest_size
    for k in range(tree.count):
        rows, columns = np.nonzero(leaf == k)
        assert tree.x[k] == pytest.approx(DOMAIN.xmin + middle[columns].mean(), abs=1e-12)
        assert tree.y[k] == pytest.approx(DOMAIN.ymin + middle[rows].mean(), abs=1e-12)


def test_planting_divides_to_the_minimum_level():
    tree = Quadtree(DOMAIN, 100)
    tree.plant()
    assert tree.count == 4**DOMAIN.min_level
    assert (tree.level[: tree.count] == DOMAIN.min_level).all()


def test_planting_again_forgets_every_division():
    tree = grown(DOMAIN, 2)
    assert tree.count > 4
    tree.plant()
    assert tree.count == 4
    assert_tiles(DOMAIN, *(v[:4] for v in (tree.level, tree.ix, tree.iy)))
    assert set(tree.leaf_of_finest.tolist()) == {0, 1, 2, 3}


def test_children_cover_their_parent_x_fastest():
    tree = grown(DOMAIN, 3, rounds=0)
    parent = np.array([2])
    x, y = tree.x[2], tree.y[2]
    children = tree.split(parent)[0]
    quarter = DOMAIN.size / 2**DOMAIN.min_level / 4.0
    expected = [(x - quarter, y - quarter), (x + quarter, y - quarter)]
    expected += [(x - quarter, y + quarter), (x + quarter, y + quarter)]
    np.testing.assert_allclose(np.column_stack([tree.x[children], tree.y[children]]), expected)
    assert (tree.level[children] == DOMAIN.min_level + 1).all()


@pytest.mark.parametrize("max_cells", [4, 6, 7, 12, 40])
def test_the_number_of_cells_is_bounded(max_cells):
    tree = Quadtree(DOMAIN, max_cells)
    tree.plant()
    for _ in range(8):
        rows = np.flatnonzero(tree.level[: tree.count] < DOMAIN.max_level)
        room = (max_cells - tree.count) // 3
        children = tree.split(rows)
        assert len(children) == min(len(rows), room)
        assert tree.count <= max_cells
    assert_tiles(DOMAIN, *(v[: tree.count] for v in (tree.level, tree.ix, tree.iy)))


def recursive_order(domain: Domain, leaves: set[tuple[int, int, int]]) -> list:
    """Leaves in the order of a walk that visits quadrants x fastest."""

    def walk(level: int, ix: int, iy: int) -> list:
        if (level, ix, iy) in leaves:
            return [(level, ix, iy)]
        if level == domain.max_level:
            return []
        out = []
        for up in (0, 1):
            for right in (0, 1):
                out += walk(level + 1, 2 * ix + right, 2 * iy + up)
        return out

    return walk(0, 0, 0)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10_000))
def test_morton_order_is_the_walk_of_the_tree(seed):
    tree = grown(DOMAIN, seed)
    place = [v[: tree.count] for v in (tree.level, tree.ix, tree.iy)]
    order = morton_order(DOMAIN, *place)
    rows = list(zip(*(v[order].tolist() for v in place), strict=True))
    assert rows == recursive_order(DOMAIN, set(rows))


def test_morton_order_at_the_deepest_level():
    domain = Domain(0.0, 0.0, 1.0, 0, 12)
    x, y = np.random.default_rng(4).integers(0, 4096, (2, 300))
    order = morton_order(domain, np.full(300, 12), x, y)

    def interleaved(k: int) -> int:
        return sum(
            ((int(x[k]) >> b & 1) << 2 * b) | ((int(y[k]) >> b & 1) << (2 * b + 1))
            for b in range(12)
        )

    codes = [interleaved(k) for k in order]
    assert codes == sorted(codes)


def test_map_raster_agrees_with_descent():
    cells = mapped(
        configured(), lambda x, y: 0.5 * ((x > 5.0) & (y > 7.0)), density=30.0, scans=1
    ).snapshot()
    assert_tiles(cells.domain, cells.level, cells.ix, cells.iy)
    raster = cells.leaf_raster()
    rng = np.random.default_rng(5)
    for column, row in rng.integers(0, cells.domain.finest_count, (150, 2)).tolist():
        assert raster[row, column] == leaf_by_descent(cells, column, row)


def test_inherited_planes_are_the_parents():
    """Children see the same plane, with a covariance larger by the misfit and never smaller."""
    domain = Domain(0.0, 0.0, 8.0, 0, 4)
    leaves = Leaves(domain, 1000)
    normal = np.array([[0.3, -0.2, 1.0]]) / np.sqrt(1.13)
    part = np.diag([1e-4, 2e-4, 1e-3])[None]
    root = np.array([0])
    leaves.set_planes(root, normal, np.array([2.0]), np.stack([part, 2.0 * part], axis=1))
    leaves.measured[root], leaves.misfit[root] = True, 0.01
    leaves.divide(root)
    assert leaves.count == 4
    assert not leaves.measured[:4].any()
    for k in range(4):
        expected = (
            2.0
            - (normal[0, 0] * (leaves.x[k] - 4) + normal[0, 1] * (leaves.y[k] - 4)) / (normal[0, 2])
        )
        assert leaves.z[k] == pytest.approx(expected, abs=1e-12)
        np.testing.assert_array_equal(leaves.normal[k], normal[0])
        assert leaves.range_part[k, 2, 2] >= part[0, 2, 2] + 0.01 - 1e-12
        assert np.linalg.eigvalsh(leaves.range_part[k]).min() > 0.0


def test_fixed_resolution_never_divides():
    config = configured(domain={"min_level": 3, "max_level": 3})
    mapper = mapped(config, lambda x, y: 0.3 * np.sin(3.0 * x), density=20.0, scans=2)
    assert mapper.snapshot().level.tolist() == [3] * 64


def test_bounded_cells_are_refused_counted_and_leave_no_hole():
    rough = np.random.default_rng(6)
    config = configured(mapping={"max_cells": 40})
    mapper = Mapper(config)
    pose = make_pose((8.0, 8.0, 500.0))
    x, y = 16.0 * rough.random((2, 20_000))
    report = mapper.update(scan(lambda x, y: 0.5 * np.sin(4.0 * x), x, y, pose, 0.06, rough), pose)
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
    empty, fresh = used.snapshot(), Mapper(config).snapshot()
    for name in ("level", "ix", "iy", "z", "normal", "count", "measured", "roughness", "observed"):
        np.testing.assert_array_equal(getattr(empty, name), getattr(fresh, name))
    assert empty.stamp_ns == 0
    assert empty.domain == domain_of(config)
    # And mapping afterwards gives what a new mapper gives.
    pose = make_pose((8.0, 8.0, 500.0))
    x, y = 16.0 * np.random.default_rng(7).random((2, 4000))
    points = scan(flat(), x, y, pose, 0.05, np.random.default_rng(8))
    new = Mapper(config)
    used.update(points, pose)
    new.update(points, pose)
    np.testing.assert_array_equal(used.snapshot().z, new.snapshot().z)
    np.testing.assert_array_equal(used.snapshot().roughness, new.snapshot().roughness)
