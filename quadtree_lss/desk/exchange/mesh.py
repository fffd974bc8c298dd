# SPDX-License-Identifier: Apache-2.0
"""The ground as a triangle mesh: PLY and binary glTF."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.arrays import Array, Bytes
from quadtree_lss.onboard.elevation.libraries import library

FAR = 10_000.0
"""Coordinates beyond lose centimetres in the 32 bits that meshes have, m."""


def ground_mesh(x: Array, y: Array, heights: Array) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (V, 3) and triangles (T, 3), counter-clockwise from above, of known ground.

    Args:
        x, y: (nx,), (ny,) m.
        heights: (ny, nx) m, NaN where unknown: squares that lack a corner are left out.
    """
    known = np.isfinite(heights)
    number = np.cumsum(known.ravel()).reshape(known.shape) - 1
    across, along = np.meshgrid(x, y)
    vertices = np.column_stack([across[known], along[known], heights[known]])
    whole = known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1] & known[1:, 1:]
    a, b = number[:-1, :-1][whole], number[:-1, 1:][whole]
    c, d = number[1:, 1:][whole], number[1:, :-1][whole]
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def write_meshes(paths: list[Path], x: Array, y: Array, heights: Array, colours: Bytes) -> Array:
    """Writes the ground as ``.ply`` (z up) or ``.glb`` (y up, as glTF has it).

    Args:
        paths: To write, told apart by their ends.
        x, y, heights: As of `ground_mesh`.
        colours: (ny, nx, 3) of the vertices.

    Returns:
        (3,) what is to be added to the mesh's coordinates, m: 0 but far from the origin.
    """
    trimesh: Any = library("trimesh", "PLY and glTF files")
    vertices, faces = ground_mesh(x, y, heights)
    shift = np.zeros(3)
    if len(vertices) and np.abs(vertices[:, :2]).max() > FAR:
        shift[:2] = np.round(vertices[:, :2].mean(axis=0))
    vertices = vertices - shift
    shown = colours[np.isfinite(heights)]
    for path in paths:
        turned = vertices
        if path.suffix == ".glb":
            turned = vertices[:, [0, 2, 1]] * (1.0, 1.0, -1.0)
        mesh = trimesh.Trimesh(turned, faces, vertex_colors=shown, process=False)
        path.write_bytes(mesh.export(file_type=path.suffix[1:]))
    return shift
