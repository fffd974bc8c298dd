# SPDX-License-Identifier: Apache-2.0
"""Occupancy grids as ``map_server`` of nav2 loads them: a picture (PGM) and a YAML file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.arrays import Array

FREE, OCCUPIED, UNKNOWN = 254, 0, 205


def write_map(path: Path, values: NDArray[np.int8], x: Array, y: Array) -> list[Path]:
    """Writes ``<path>.pgm`` and ``<path>.yaml``, read in the mode ``trinary``.

    Args:
        path: Without an end.
        values: (ny, nx) as of OccupancyGrid: 0 free, 100 occupied, -1 unknown.
        x, y: (nx,), (ny,) of the cells' centres, m.
    """
    pixels = np.full(values.shape, UNKNOWN, np.uint8)
    pixels[values == 0] = FREE
    pixels[values == 100] = OCCUPIED
    picture, told = path.with_suffix(".pgm"), path.with_suffix(".yaml")
    height, width = values.shape
    picture.write_bytes(b"P5\n%d %d\n255\n" % (width, height) + pixels[::-1].tobytes())
    step = float(x[1] - x[0]) if len(x) > 1 else 1.0
    told.write_text(
        f"image: {picture.name}\nmode: trinary\nresolution: {step:.9g}\n"
        f"origin: [{x[0] - 0.5 * step:.9g}, {y[0] - 0.5 * step:.9g}, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n",
        encoding="utf-8",
    )
    return [picture, told]
