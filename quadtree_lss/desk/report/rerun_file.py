# SPDX-License-Identifier: Apache-2.0
"""A results folder as a recording of Rerun: ground, sites, target and scans over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from quadtree_lss.desk.exchange.mesh import ground_mesh
from quadtree_lss.desk.report.content import Content
from quadtree_lss.desk.report.palette import EXCLUDED_COLOUR, SAFE_COLOUR, UNSEEN_COLOUR
from quadtree_lss.onboard.arrays import Bytes, Mask
from quadtree_lss.onboard.elevation.libraries import ExchangeError

MOST = 60
"""Passes that are written."""
LACKING = "rerun is not installed, which --rerun needs: pip install 'quadtree_lss[rerun]'"


def write_rerun(content: Content, path: Path) -> None:
    """Heights are those at the end, m, map frame; colours: where landing was allowed.

    Raises:
        ExchangeError: the extra ``rerun`` is not installed, or there is no history.
    """
    try:
        import rerun as rr
    except ImportError:
        raise ExchangeError(LACKING) from None
    grid, history = content.grid, content.history
    if not len(history.get("answer_stamp_ns", ())):
        msg = f"there is no history of this map for {path.name}"
        raise ExchangeError(msg)
    out = rr.RecordingStream("quadtree_lss")
    out.save(path)
    out.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    places, triangles = ground_mesh(grid["x"], grid["y"], grid["elevation"])
    known = np.isfinite(grid["elevation"]).ravel()
    out.log(
        "map/ground", rr.Mesh3D(vertex_positions=places, triangle_indices=triangles), static=True
    )
    stamps = history["answer_stamp_ns"]
    mapped = np.flatnonzero(stamps > 0)
    for answer in mapped[np.unique(np.linspace(0, len(mapped) - 1, MOST).round().astype(int))]:
        out.set_time("bag", timestamp=np.datetime64(int(stamps[answer]), "ns"))
        seen, allowed = (
            content.then(name, np.array([answer])).ravel().astype(bool)[known]
            for name in ("seen", "allowed")
        )
        out.log("map/ground", rr.Mesh3D.from_fields(vertex_colors=colours(seen, allowed)))
        own = history["site_answer"] == answer
        sites, likely = history["site_position"][own], history["site_probability"][own]
        labels = [f"{k}: {100 * p:.1f} %" for k, p in enumerate(likely, start=1)]
        out.log("map/sites", rr.Points3D(sites, labels=labels, radii=0.3))
        target = history["target"][answer]
        place = target[None, 1:] if target[0] else np.zeros((0, 3))
        out.log("map/target", rr.Points3D(place, radii=0.6, colors=[0, 95, 165]))
        if len(likely):
            out.log("probability", rr.Scalars(float(likely[0])))
    edge = history["scan_outline"]
    level = np.full((*edge.shape[:2], 1), np.nanmedian(grid["elevation"]))
    rings = np.concatenate([edge, level], axis=2)
    for stamp, place, ring in zip(
        history["scan_stamp_ns"], history["scan_position"], rings, strict=True
    ):
        out.set_time("bag", timestamp=np.datetime64(int(stamp), "ns"))
        out.log("map/lidar", rr.Points3D(place[None], radii=0.5))
        out.log("map/scan", rr.LineStrips3D([np.vstack([ring, ring[:1]])]))
    out.flush()


def colours(seen: Mask, allowed: Mask) -> Bytes:
    """(N, 3) of grid points by what is known of them."""
    names = (UNSEEN_COLOUR, EXCLUDED_COLOUR, SAFE_COLOUR)
    table = np.array([list(bytes.fromhex(name[1:])) for name in names], np.uint8)
    return np.asarray(table[np.where(seen, 1 + allowed.astype(int), 0)])
