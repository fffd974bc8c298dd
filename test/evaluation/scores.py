# SPDX-License-Identifier: Apache-2.0
"""Results and truth files made up so that every score is known."""

import json
from dataclasses import replace

import numpy as np

from quadtree_lss.desk.exchange.saved import cells_arrays
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.domain import Domain

SPACING = 0.25


def ground(x, y):
    """A tilted plane."""
    return 0.1 * x - 0.05 * y + 2.0


def write_truth(path, *, box=(-8.0, 8.0, -8.0, 8.0), safe=None, elevation=ground):
    """A truth file of 24 m × 24 m at 0.2 m posts; everything is safe unless told otherwise."""
    axis = np.linspace(-12.0, 12.0, 121)
    grid_x = np.arange(box[0], box[1] + 1e-9, SPACING)
    grid_y = np.arange(box[2], box[3] + 1e-9, SPACING)
    gx, gy = np.meshgrid(grid_x, grid_y)
    np.savez(
        path,
        x=axis,
        y=axis,
        elevation=elevation(axis[None, :], axis[:, None]),
        safe_x=grid_x,
        safe_y=grid_y,
        safe=np.ones(gx.shape, bool) if safe is None else safe(gx, gy),
        box=np.array(box),
        scan_stamp_ns=np.array([0]),
        scan_position=np.zeros((1, 3)),
        scan_quaternion_xyzw=np.array([[0.0, 0.0, 0.0, 1.0]]),
    )
    return path


def write_results(
    folder,
    *,
    offset=0.0,
    estimated=None,
    observed=None,
    called_safe=None,
    unseen=None,
    unmapped=None,
    bounds=None,
    sites=((0.0, 0.0),),
    spacing=SPACING,
):
    """A results folder over 16 m × 16 m: coarse leaves in the west, fine ones in the east.

    Leaves lie on `ground` plus ``offset``; ``estimated`` and ``observed`` (all of the leaf or
    nothing) are functions of their x, y, ``called_safe``, ``unseen`` and ``unmapped`` (seen, not
    yet mapped) of the grid points'. ``bounds`` are the least and the greatest height of every leaf.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows = [(3, i, j) for i in range(4) for j in range(8)]  # 2 m
    rows += [(5, i, j) for i in range(16, 32) for j in range(32)]  # 0.5 m
    level, ix, iy = np.array(rows).T
    size = 16.0 / 2.0**level
    x, y = -8.0 + (ix + 0.5) * size, -8.0 + (iy + 0.5) * size
    z = ground(x, y) + offset
    low, high = (np.nan, np.nan) if bounds is None else bounds
    cells = CellMap(
        stamp_ns=98,
        domain=Domain(-8.0, -8.0, 16.0, 3, 5),
        level=level.astype(np.uint8),
        ix=ix.astype(np.uint32),
        iy=iy.astype(np.uint32),
        z=z if estimated is None else np.where(estimated(x, y), z, np.nan),
        normal=np.tile([-0.1, 0.05, 1.0] / np.linalg.norm([-0.1, 0.05, 1.0]), (x.size, 1)),
        covariance_range=np.zeros((x.size, 3, 3)),
        covariance_pose=np.zeros((x.size, 3, 3)),
        count=np.full(x.size, 10, np.uint32),
        measured=np.ones(x.size, bool),
        roughness=np.zeros(x.size),
        exception_fraction=np.zeros(x.size),
        feature=np.full((x.size, 5), np.nan),
        low=np.full(x.size, low),
        high=np.full(x.size, high),
        coverage=np.ones(x.size),
        observed=np.ones((32, 32), bool),
        known=np.ones((32, 32), bool),
    )
    if observed is not None:
        cells = replace(cells, observed=observed(x, y)[cells.leaf_raster()])
    np.savez(folder / "cells.npz", **cells_arrays(cells))
    axis = -8.0 + spacing * np.arange(round(16.0 / spacing) + 1)
    gx, gy = np.meshgrid(axis, axis)
    hidden = np.zeros(gx.shape, bool) if unseen is None else unseen(gx, gy)
    partly = np.zeros(gx.shape, bool) if unmapped is None else unmapped(gx, gy)
    hidden |= partly
    safe = np.ones(gx.shape, bool) if called_safe is None else called_safe(gx, gy)
    np.savez(
        folder / "grid.npz",
        x=axis,
        y=axis,
        elevation=ground(gx, gy) + offset,
        slope_deg=np.full(gx.shape, 6.4),
        hazard=(np.where(hidden, 128, 0) + np.where(partly, 64, 0)).astype(np.uint8),
        safe=safe & ~hidden,
        score=np.where(safe & ~hidden, gx, np.nan),
    )
    header = "rank,x,y,z,nx,ny,nz,score,slope_deg,roughness,hazard_distance,subscale_height"
    lines = [
        f"{k + 1},{sx},{sy},{ground(sx, sy)},0,0,1,0,0,0,0,0" for k, (sx, sy) in enumerate(sites)
    ]
    (folder / "sites.csv").write_text("\n".join([header, *lines]) + "\n")
    (folder / "timing.csv").write_text(
        "stamp_ns,points,points_used,leaves,divisions,map_ms\n"
        + "".join(f"{k},100,100,10,0,{k + 1.0}\n" for k in range(99))
    )
    (folder / "summary.json").write_text(json.dumps({"scans": 99}))
    return folder
