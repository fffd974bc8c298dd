# SPDX-License-Identifier: Apache-2.0
"""Planes of higher levels fused from leaves, against a direct fit of all the points below."""

import dataclasses

import numpy as np
import pytest
from core.builders import configured, mapped
from core.kernels import minus
from core.scenes import GROUND, make_pose, pose_covariance, scan, scattered

from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.tree.ancestors import fuse_to_level
from quadtree_lss.onboard.core.tree.cell_map import CellMap


def one_scan(level: int, covariance: np.ndarray, seed: int = 1) -> CellMap:
    config = configured(levels=(level, level), noise=0.03)
    rng = np.random.default_rng(seed)
    pose = make_pose((40.0, -30.0, 500.0), covariance)
    mapper = Mapper(config)
    x, y = scattered(rng, 0.0, 0.0, 16.0, 16_000)
    mapper.update(scan(GROUND, x, y, pose, 0.03, rng), pose)
    return mapper.snapshot()


@pytest.mark.parametrize("level", [0, 1, 2, 4])
def test_fused_planes_are_those_of_a_direct_fit(level):
    """On planar ground the leaves' planes are sufficient: nothing is lost by fusing them."""
    covariance = pose_covariance(0.3, 1e-3)
    direct, fused = one_scan(level, covariance), fuse_to_level(one_scan(4, covariance), level)
    order = np.lexsort((direct.ix, direct.iy))
    cell = (direct.iy.astype(int) << level) + direct.ix
    np.testing.assert_array_equal(fused.cell, cell[order])
    np.testing.assert_allclose(fused.planes[:, :2], np.stack([direct.x, direct.y], 1)[order])
    sigma = np.sqrt(np.einsum("mii->mi", direct.covariance_range[order]))
    pairs = zip(fused.planes[:, 3:], direct.normal[order], strict=True)
    tilt = np.abs([minus(one, other) for one, other in pairs])
    # Bins move by the noise across the ray, and small leaves' own tilt weights: second order.
    assert (tilt < 0.7 * sigma[:, :2]).all()
    assert (np.abs(fused.planes[:, 2] - direct.z[order]) < 0.5 * sigma[:, 2]).all()
    # What a cell's points leave out by chance makes single cells less certain.
    parts = fused.range_part, direct.covariance_range[order]
    part, other = (np.median(of, axis=0) for of in parts)
    scale = np.sqrt(np.outer(np.diag(other), np.diag(other)))
    assert (np.abs(part - other) <= 0.15 * scale).all()


def test_each_leaf_finds_its_ancestor():
    cells = mapped(configured(noise=0.03), lambda x, y: 0.5 * (x > 5.1), density=50.0).snapshot()
    for level in range(5):
        fused = fuse_to_level(cells, level)
        size = float(cells.domain.cell_size(level))
        for k in range(len(cells.level)):
            a = fused.of_leaf[k]
            if cells.level[k] < level:
                assert a == -1
                continue
            x, y = fused.planes[a, :2]
            assert max(abs(cells.x[k] - x), abs(cells.y[k] - y)) <= 0.5 * size


def test_inherited_leaves_are_no_information():
    cells = one_scan(4, pose_covariance(0.1, 1e-6))
    inherited = (cells.ix + cells.iy) % 2 == 0
    wrong = cells.z + 5.0 * inherited
    poisoned = dataclasses.replace(cells, measured=~inherited, z=wrong)
    fused, full = fuse_to_level(poisoned, 2), fuse_to_level(cells, 2)
    assert np.abs(fused.planes - full.planes)[:, 2].max() < 0.05
    ratio = fused.range_part[:, 2, 2] / full.range_part[:, 2, 2]
    np.testing.assert_allclose(ratio, 2.0, rtol=0.3)


def test_ancestors_without_a_measured_leaf_do_not_exist():
    cells = one_scan(4, pose_covariance(0.1, 1e-6))
    west = dataclasses.replace(cells, measured=cells.x < 8.0)
    fused = fuse_to_level(west, 1)
    assert fused.cell.tolist() == [0, 2]
    assert (fused.of_leaf[cells.x > 8.0] == -1).all()
    empty = dataclasses.replace(cells, measured=np.zeros(len(cells.z), dtype=bool))
    assert len(fuse_to_level(empty, 1).cell) == 0


def test_leaves_of_one_steep_plane_give_that_plane_wherever_they_lie():
    """Exactly, though some leaves were never measured and others by more points."""
    gradient = np.array([1.2, -0.9])
    cells = one_scan(4, pose_covariance(0.1, 1e-6))
    normal = np.append(-gradient, 1.0) / np.sqrt(1.0 + gradient @ gradient)
    z = gradient @ np.array([cells.x, cells.y])
    steep = dataclasses.replace(
        cells,
        z=z,
        normal=np.tile(normal, (len(z), 1)),
        measured=cells.x + 0.3 * cells.y < 9.0,
        count=(1 + 10 * cells.ix).astype(cells.count.dtype),
    )
    for level in range(4):
        fused = fuse_to_level(steep, level).planes
        np.testing.assert_allclose(fused[:, 2], fused[:, :2] @ gradient, atol=1e-9)
        np.testing.assert_allclose(fused[:, 3:], np.tile(normal, (len(fused), 1)), atol=1e-9)
