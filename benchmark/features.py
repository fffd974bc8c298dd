# SPDX-License-Identifier: Apache-2.0
"""Subscale features of hemispheres in flat 2 m cells: detection, height, position, false alarms."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import configuration, machine, table

from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.tree.cell_map import peak

#: Height (m) at x, y (m).
Ground = Callable[[np.ndarray, np.ndarray], np.ndarray]
#: Side of a cell, m; number of cells along a side of the field, each with one hemisphere.
SIDE, CELLS = 2.0, 16
#: Smallest distance of a hemisphere from the edge of its cell, m.
MARGIN = 0.05
#: Classes of radii, m; the last class contains all.
CLASSES = ((0.15, 0.2), (0.2, 0.3), (0.3, 0.4), (0.15, 0.4))


@dataclass(frozen=True)
class Hemispheres:
    """One hemisphere in each cell, row by row: radius and centre (K,), m."""

    radius: np.ndarray
    x: np.ndarray
    y: np.ndarray

    def ground(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Height of hemispheres on flat ground; see `Ground`."""
        cell = (y // SIDE).astype(int) * CELLS + (x // SIDE).astype(int)
        square = self.radius[cell] ** 2 - (x - self.x[cell]) ** 2 - (y - self.y[cell]) ** 2
        return np.sqrt(np.maximum(square, 0.0))


def main() -> None:
    """Print detections of hemispheres and false alarms on plain ground."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(101, 111)))
    parser.add_argument("--density", type=float, default=100.0, help="points / m^2 and scan")
    parser.add_argument("--scans", type=int, default=3)
    parser.add_argument("--noise", type=float, default=0.04, help="of the range, m")
    options = parser.parse_args()
    level = int(np.log2(CELLS))
    domain = {"xmin": 0.0, "ymin": 0.0, "size": SIDE * CELLS, "min_level": level}
    domain = {f"domain__{name}": value for name, value in domain.items()}
    given = {"lidar__range_noise": options.noise, "lss__grid_spacing": SIDE}
    config = configuration(**domain, domain__max_level=level, **given)
    print(machine())
    fields = [hemispheres(np.random.default_rng(seed)) for seed in options.seeds]
    how = options.density, options.scans
    found = [
        features(config, field.ground, seed, *how)
        for seed, field in zip(options.seeds, fields, strict=True)
    ]
    show_found(fields, np.concatenate(found))
    rows = []
    for name, ground in PLAIN.items():
        states = [features(config, ground, seed, *how) for seed in options.seeds]
        alarms = [np.isfinite(features_found[:, 1]) for features_found in states]
        rows.append([name, np.size(alarms), f"{100.0 * np.mean(alarms):.2f}"])
    table("Plain ground: false alarms", ["ground", "cells", "%"], rows)


PLAIN: dict[str, Ground] = {
    "level": lambda x, y: np.zeros(np.shape(x)),
    "slope of 10 degrees": lambda x, y: 0.15 * x - 0.09 * y,
}


def hemispheres(rng: np.random.Generator) -> Hemispheres:
    """Draw radii and centres from uniform distributions."""
    smallest, largest = CLASSES[-1]
    count = CELLS**2
    radius = rng.uniform(smallest, largest, count)
    reach = 0.5 * SIDE - radius - MARGIN
    row, column = np.divmod(np.arange(count), CELLS)
    x = SIDE * (column + 0.5) + reach * rng.uniform(-1.0, 1.0, count)
    y = SIDE * (row + 0.5) + reach * rng.uniform(-1.0, 1.0, count)
    return Hemispheres(radius, x, y)


def features(config: Config, ground: Ground, seed: int, density: float, scans: int) -> np.ndarray:
    """Features (K, 5) of the cells, row by row, after scans with an exact pose."""
    rng = np.random.default_rng((seed, 1))
    size = config.domain.size
    lidar = np.array([0.5 * size, 0.5 * size, 500.0])
    looking_down = np.diag([1.0, -1.0, -1.0])
    mapper = Mapper(config)
    for k in range(scans):
        x, y = rng.uniform(0.0, size, (2, round(density * size**2)))
        ray = np.column_stack([x, y, ground(x, y)]) - lidar
        noise = config.lidar.range_noise * rng.standard_normal(len(ray))
        ray *= (1.0 + noise / np.linalg.norm(ray, axis=1))[:, None]
        pose = Pose(1 + k, lidar, looking_down, 1e-12 * np.eye(6))
        mapper.update(ray @ looking_down, pose)
    cells = mapper.snapshot()
    return cells.feature[np.lexsort((cells.ix, cells.iy))]


def show_found(fields: list[Hemispheres], features_found: np.ndarray) -> None:
    """Print a row for each class of radii."""
    radius, x, y = (
        np.concatenate([getattr(f, name) for f in fields]) for name in ("radius", *"xy")
    )
    row, column = np.divmod(np.arange(len(features_found)) % CELLS**2, CELLS)
    detected = np.isfinite(features_found[:, 1])
    height = peak(features_found) / radius - 1.0
    centre = np.hypot(
        SIDE * (column + 0.5) + features_found[:, 2] - x,
        SIDE * (row + 0.5) + features_found[:, 3] - y,
    )
    rows = []
    for low, high in CLASSES:
        of = (radius >= low) & (radius <= high)
        seen = of & detected
        size_error = np.abs(height[seen])
        rows.append(
            [f"{low:g} - {high:g} m", np.count_nonzero(of), percent(detected[of])]
            + [
                f"{100.0 * np.median(height[seen]):+.1f}",
                f"{100.0 * np.percentile(size_error, 95.0):.1f}",
            ]
            + [percent(size_error <= 0.35), percent(size_error <= 0.15)]
            + [f"{100.0 * v:.1f}" for v in np.percentile(centre[seen], (50.0, 95.0))]
            + [percent(centre[seen] <= 0.1)]
        )
    table(
        "Hemispheres",
        ["radius", "cells", "found %", "height off %", "95 % of |.|", "in 35 %", "in 15 %"]
        + ["centre cm", "95 %", "in 10 cm"],
        rows,
    )


def percent(share: np.ndarray) -> str:
    """Format a mean of booleans in per cent."""
    return f"{100.0 * np.mean(share):.1f}"


if __name__ == "__main__":
    main()
