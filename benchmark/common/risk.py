# SPDX-License-Identifier: Apache-2.0
"""Flights that judge probabilities: simulated fields, noise, and real terrains; kept in files."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
from scipy.interpolate import RectBivariateSpline

from quadtree_lss.lab.evaluation.risk_flights import CASES, PARTS, Conditions, Mapped, fly
from quadtree_lss.lab.simulation.hazard_field import FIELDS, hazard_field, strewn
from quadtree_lss.lab.simulation.terrain import Terrain, load_terrain
from quadtree_lss.onboard.config.settings import Config

HALF, POST = 40.0, 0.1


def piece(rng: np.random.Generator, terrain: Terrain) -> Terrain:
    """80 x 80 m somewhere in a terrain, or what it has, turned at random; posts 0.1 m apart."""
    xmin, xmax, ymin, ymax = terrain.bounds
    half = POST * np.floor(min(HALF, 0.5 * (xmax - xmin), 0.5 * (ymax - ymin)) / POST - 1e-6)
    free = np.array([0.5 * (xmax - xmin) - half, 0.5 * (ymax - ymin) - half])
    cx, cy = np.array([xmin + xmax, ymin + ymax]) / 2.0 + rng.uniform(-1.0, 1.0, 2) * free
    own = np.linspace(-half, half, round(2.0 * half / POST) + 1)
    near = [np.abs(axis - c) <= half + 5.0 for axis, c in ((terrain.y, cy), (terrain.x, cx))]
    ground = RectBivariateSpline(
        terrain.y[near[0]], terrain.x[near[1]], terrain.elevation[np.ix_(*near)]
    )
    z = np.rot90(ground(own + cy, own + cx), rng.integers(4))
    return Terrain(own, own, np.ascontiguousarray(z - z.mean()))


def flights(
    cases: list[str], seeds: list[int], config: Config, terrains: list[Path], folder: Path | None
) -> dict[str, list[list[Mapped]]]:
    """Maps after parts of flights, by case; real terrains with and without rocks."""
    out: dict[str, list[list[Mapped]]] = {name: [] for name in cases}
    for path in terrains:
        out |= {path.stem: [], f"{path.stem} + rocks": []}
    for name, of_case in out.items():
        for seed in seeds:
            kept = None if folder is None else folder / f"{name.replace(' ', '')}_{seed}.pkl"
            if kept is not None and kept.exists():
                of_case.append(pickle.loads(kept.read_bytes()))
                continue
            rng = np.random.default_rng([seed, 2])
            if name in CASES:
                terrain = hazard_field(rng, FIELDS[CASES[name].field])
            else:
                real = next(path for path in terrains if path.stem == name.split()[0])
                terrain = piece(rng, load_terrain(real))
                terrain = strewn(rng, terrain, 0.05) if name.endswith("rocks") else terrain
            of_case.append(fly(terrain, seed, CASES.get(name, Conditions()), config, PARTS))
            if kept is not None:
                kept.parent.mkdir(parents=True, exist_ok=True)
                kept.write_bytes(pickle.dumps(of_case[-1]))
            print(f"flown: {name}, seed {seed}", flush=True)
    return out
