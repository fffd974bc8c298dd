# SPDX-License-Identifier: Apache-2.0
"""Degenerate geometry and degenerate pose covariances, many cells at a time.

Every scan fills each cell of the map with points of a kind of its own, so that each example tries
two to four dozen sets, under one pose covariance, which the messages' checks did not mend.
"""

import numpy as np
import pytest
from core.builders import METHODS, assert_sound, configured, random_covariances
from hypothesis import example, given, settings
from hypothesis import strategies as st

from quadtree_lss.onboard.core.geometry.rotations import exp
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.tree.ancestors import fuse_to_level

SIDE = 4.0
KINDS = "spread, none, one, two, duplicates, one place and one other, line, nearly a line, wall"
KINDS += ", leaning wall, vertical line, corner, edge, huge relief, tiny patch, lattice"
KINDS = [*KINDS.split(", "), "repeated lattice"]
LIDARS = {
    "above": (8.0, 8.0, 300.0),
    "close": (8.0, 8.0, 2.0),
    "oblique": (-200.0, 60.0, 120.0),
    "grazing": (-400.0, 8.0, 0.5),
    "below": (8.0, -50.0, -80.0),
    "far": (9e3, -9e3, 1.2e4),
}
COVARIANCES = "zero, tiny, usual, huge, one axis, one direction of all six, rank three, asymmetric"
COVARIANCES = [*COVARIANCES.split(", "), "slightly negative"]


def points_of(kind: str, rng: np.random.Generator) -> np.ndarray:
    """(N, 3) about a cell's south-western corner."""
    n = int(rng.integers(3, 40))
    x, y = SIDE * rng.random((2, n))
    z = 0.05 * rng.standard_normal(n) + 0.2 * x
    if kind == "none":
        return np.zeros((0, 3))
    if kind in ("one", "two"):
        n = ("one", "two").index(kind) + 1
        return np.column_stack([x, y, z])[:n]
    if kind == "duplicates":
        x, y, z = np.full(n, x[0]), np.full(n, y[0]), np.full(n, z[0])
    elif kind == "one place and one other":
        x[1:], y[1:], z[1:] = x[1], y[1], z[1]
    elif kind in ("line", "nearly a line"):
        direction = rng.random(2)
        x, y = SIDE * np.outer(direction, rng.random(n))
        if kind == "nearly a line":
            y = np.clip(y + 10.0 ** rng.uniform(-14, -2) * rng.standard_normal(n), 0.0, SIDE)
    elif kind == "wall":
        x, z = np.full(n, x[0]), 30.0 * rng.random(n)
    elif kind == "leaning wall":
        z = 1e3 * x
    elif kind == "vertical line":
        x, y, z = np.full(n, x[0]), np.full(n, y[0]), 5.0 * rng.standard_normal(n)
    elif kind == "corner":
        x, y = x * 1e-9, y * 1e-9
    elif kind == "edge":
        x = x * 0.0
    elif kind == "huge relief":
        z = 1e4 * rng.standard_normal(n)
    elif kind == "tiny patch":
        x, y = 1.0 + 1e-6 * x, 1.0 + 1e-6 * y
    elif "lattice" in kind:
        x, y = np.floor(x) + 0.5, np.floor(y) + 0.5
        z = z * 0.0
    points = np.column_stack([x, y, z])
    return np.repeat(points, 3, axis=0) if kind == "repeated lattice" else points


def covariance_of(kind: str, rng: np.random.Generator) -> np.ndarray:
    """(6, 6) pose covariance."""
    usual = random_covariances(rng, 1, 6, 0.05)[0]
    usual[3:] *= 1e-2
    usual[:, 3:] *= 1e-2
    direction = rng.standard_normal(6)
    if kind == "zero":
        return np.zeros((6, 6))
    if kind == "tiny":
        return 1e-24 * np.eye(6)
    if kind == "huge":
        return np.diag([1e6] * 3 + [1.0] * 3)
    if kind == "one axis":
        return np.diag(np.eye(6)[rng.integers(6)])
    if kind == "one direction of all six":
        return 0.01 * np.outer(direction, direction)
    if kind == "rank three":
        root = 0.1 * rng.standard_normal((6, 3))
        return root @ root.T
    if kind == "asymmetric":
        return usual * (1.0 + 1e-6 * rng.standard_normal((6, 6)))
    if kind == "slightly negative":
        return usual - 1.0001 * np.linalg.eigvalsh(usual)[0] * np.eye(6)
    return usual


def scan_of(kinds: list[str], rng: np.random.Generator) -> np.ndarray:
    """(N, 3) points in the map frame: one kind for each of the 16 cells."""
    parts = []
    for k, kind in enumerate(kinds):
        corner = np.array([SIDE * (k % 4), SIDE * (k // 4), 0.0])
        parts.append(points_of(kind, rng) + corner)
    return np.concatenate(parts)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@settings(max_examples=150)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from(METHODS),
    st.sampled_from(sorted(LIDARS)),
    st.lists(st.sampled_from(COVARIANCES), min_size=2, max_size=3),
)
@example(277841, "fit", "far", ["zero", "one axis"])
def test_no_geometry_and_no_covariance_breaks_the_map(seed, method, lidar, poses):
    """5,000 cells and more, of many kinds or of one alone; NumPy warns of nothing."""
    rng = np.random.default_rng(seed)
    far, mapping = {"min_range": 0.0, "max_range": 1e5}, {"paper": method, "max_cells": 120}
    config = configured(levels=(2, 4), lidar=far, mapping=mapping)
    mapper = Mapper(config)
    for k, pose_kind in enumerate(poses):
        turn = exp(rng.normal(0.0, 1.0, 3))
        position = np.array(LIDARS[lidar]) + rng.standard_normal(3)
        pose = Pose(k, position, turn, covariance_of(pose_kind, rng))
        kinds = rng.choice(KINDS, 16) if rng.random() < 0.7 else np.repeat(rng.choice(KINDS), 16)
        points = (scan_of(list(kinds), rng) - position) @ turn
        report = mapper.update(points, pose)
        assert report.points_used + sum(report.dropped.values()) == len(points)
        cells = mapper.snapshot()
        assert_sound(cells)
        for name in ("division_sum", "square_sum", "distance_sum", "exception_sum"):
            assert np.isfinite(mapper.leaves.rows[name][: mapper.leaves.count]).all(), name
    parents = fuse_to_level(cells, 1).planes
    assert np.isfinite(parents).all()
    assert (parents[:, 5] > 0.0).all()
