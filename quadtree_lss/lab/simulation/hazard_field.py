# SPDX-License-Identifier: Apache-2.0
"""A synthetic lunar hazard field: undulation, degraded craters, rocks and rock piles."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import gaussian_filter

from quadtree_lss.lab.simulation.terrain import Terrain
from quadtree_lss.onboard.arrays import Array


@dataclass(frozen=True)
class HazardField:
    """Parameters of a field; lengths in m, rates per m². Rocks larger than D cover the fraction
    F(D) = k exp(−q D) of the ground, q = 1.79 + 0.152/k (Golombek and Rapp)."""

    size: float = 100.0
    post: float = 0.1
    rock_abundance: float = 0.05
    rock_smallest: float = 0.1
    rock_largest: float = 1.0
    rock_height: tuple[float, float] = (0.4, 0.6)  # of the diameter
    rock_axes: tuple[float, float] = (0.75, 1.0)  # shorter over longer axis in plan
    piles: float = 3e-3
    craters: float = 6e-3
    crater_smallest: float = 1.5
    crater_largest: float = 5.0
    crater_depth: float = 0.1  # of the diameter
    slope_rms_deg: float = 1.5
    texture: float = 0.01  # standard deviation of the roughness of the soil
    texture_length: float = 0.25  # correlation length of that roughness


#: Fields by name.
FIELDS = {
    "default": HazardField(),
    "rocky": HazardField(rock_abundance=0.10, piles=6e-3),
    "sparse": HazardField(rock_abundance=0.02, piles=1e-3),
    "steep": HazardField(slope_rms_deg=4.0, craters=12e-3),
    "broken": HazardField(slope_rms_deg=6.0, craters=12e-3),
    "rough": HazardField(rock_abundance=0.10, slope_rms_deg=3.0, texture=0.02),
    "smooth": HazardField(rock_abundance=0.0, slope_rms_deg=6.0, craters=12e-3),
}


def sample_rock_diameters(
    generator: np.random.Generator, area: float, abundance: float, smallest: float, largest: float
) -> Array:
    """Draw diameters (m) of rocks on ``area`` (m²). A rock covers π D²/4, so the number density is
    n(D) = 4 k q exp(−q D)/(π D²)."""
    q = 1.79 + 0.152 / abundance
    diameter = np.geomspace(smallest, largest, 4001)
    density = 4.0 * abundance * q * np.exp(-q * diameter) / (np.pi * diameter**2)
    cumulative = cumulative_trapezoid(density, diameter, initial=0.0)
    count = generator.poisson(area * cumulative[-1])
    drawn = np.interp(generator.uniform(0.0, cumulative[-1], count), cumulative, diameter)
    return np.asarray(drawn)


def hazard_field(generator: np.random.Generator, field: HazardField) -> Terrain:
    """Make a field centred on the origin."""
    count = round(field.size / field.post) + 1
    axis = np.linspace(-0.5 * field.size, 0.5 * field.size, count)
    ground = _undulation(generator, axis, field.slope_rms_deg)
    soil, length = generator.standard_normal((count, count)), field.texture_length / field.post
    soil = gaussian_filter(soil, length / np.sqrt(2.0), mode="wrap")
    ground += field.texture * (soil / soil.std())
    _add_craters(generator, axis, ground, field)
    if field.rock_abundance > 0.0:
        ground += _rock_heights(generator, axis, field)
    return Terrain(axis, axis, ground)


def add_rocks_to(generator: np.random.Generator, terrain: Terrain, abundance: float) -> Terrain:
    """Add rocks and rock piles to a terrain, within 100 m by 100 m around its centre."""
    xmin, xmax, ymin, ymax = terrain.bounds
    field = HazardField(rock_abundance=abundance)
    size = field.post * np.floor(min(field.size, xmax - xmin, ymax - ymin) / field.post)
    field = replace(field, size=float(size))
    own = np.linspace(-0.5 * field.size, 0.5 * field.size, round(field.size / field.post) + 1)
    rocks = _rock_heights(generator, own, field)
    x = np.clip(own + 0.5 * (xmin + xmax), xmin, xmax)
    y = np.clip(own + 0.5 * (ymin + ymax), ymin, ymax)
    return Terrain(x, y, terrain.elevation_at(x[None, :], y[:, None]) + rocks)


def _undulation(generator: np.random.Generator, axis: Array, slope_rms_deg: float) -> Array:
    """Sum of plane waves of 12 to 60 m with the given root mean square slope."""
    waves = 16
    wavelength = np.geomspace(12.0, 60.0, waves)
    heading = generator.uniform(0.0, np.pi, waves)
    phase = generator.uniform(0.0, 2.0 * np.pi, waves)
    number = 2.0 * np.pi / wavelength
    amplitude = np.tan(np.radians(slope_rms_deg)) * np.sqrt(2.0 / waves) / number
    kx, ky = number * np.cos(heading), number * np.sin(heading)
    # exp(i(kx x + ky y + phase)) is separable: one matrix product for all waves.
    along_x = np.exp(1j * kx[:, None] * axis[None, :])
    along_y = np.exp(1j * (ky[None, :] * axis[:, None] + phase[None, :])) * amplitude[None, :]
    return np.ascontiguousarray((along_y @ along_x).real)


def _add_craters(
    generator: np.random.Generator, axis: Array, ground: Array, field: HazardField
) -> None:
    """Add degraded craters, a smooth bowl with a low rim; sizes by a cumulative power law D⁻²."""
    count = generator.poisson(field.craters * field.size**2)
    small, large = field.crater_smallest**-2, field.crater_largest**-2
    diameters = (small - generator.uniform(0.0, 1.0, count) * (small - large)) ** -0.5
    centres = generator.uniform(axis[0], axis[-1], (count, 2))
    freshness = generator.uniform(0.5, 1.0, count)
    for diameter, (cx, cy), fresh in zip(diameters, centres, freshness, strict=True):
        ends = np.searchsorted(axis, [(c - diameter, c + diameter) for c in (cy, cx)])
        rows, columns = (slice(*pair) for pair in ends)
        rho = np.hypot(axis[None, columns] - cx, axis[rows, None] - cy) / (0.5 * diameter)
        depth = field.crater_depth * diameter * fresh
        bowl = np.square(np.maximum(1.0 - rho**2, 0.0))
        rim = np.exp(-np.square((rho - 1.0) / 0.3))
        ground[rows, columns] += depth * (0.15 * rim - bowl)


def _rock_heights(generator: np.random.Generator, axis: Array, field: HazardField) -> Array:
    """Heights over the ground (n, n) of half-buried rocks and of heaps of 8 to 20 rocks."""
    rocks = np.zeros((axis.size, axis.size))
    diameters = sample_rock_diameters(
        generator, field.size**2, field.rock_abundance, field.rock_smallest, field.rock_largest
    )
    count = diameters.size
    centres = generator.uniform(axis[0], axis[-1], (count, 2))
    heights = diameters * generator.uniform(*field.rock_height, count)
    axes = generator.uniform(*field.rock_axes, count)
    yaws = generator.uniform(0.0, np.pi, count)
    _add_rocks(axis, rocks, (*centres.T, diameters, heights, axes, yaws))
    stones = []
    for _ in range(generator.poisson(field.piles * field.size**2)):
        centre = generator.uniform(axis[0] + 2.0, axis[-1] - 2.0, 2)
        spread = generator.uniform(0.3, 0.5)
        for _ in range(int(generator.integers(8, 21))):
            x, y = centre + np.clip(generator.normal(0.0, spread, 2), -1.0, 1.0)
            diameter = generator.uniform(0.25, 0.7)
            stones.append((x, y, diameter, generator.uniform(0.0, np.pi)))
    x, y, diameters, yaws = np.array(stones).reshape(-1, 4).T
    axes = np.full(len(stones), 0.85)
    _add_rocks(axis, rocks, (x, y, diameters, 0.5 * diameters, axes, yaws), heaped=True)
    return rocks


def _add_rocks(
    axis: Array, rocks: Array, stones: tuple[Array, ...], *, heaped: bool = False
) -> None:
    """Raise the posts to half-buried ellipsoids: x, y, diameter, height, ratio of axes, yaw (K,).
    ``heaped``: each lies at 0.6 of the height of the rocks below its centre, at most 0.6 m up."""
    x, y, diameter, height, axes, yaw = stones
    long, short = 0.5 * diameter / np.sqrt(axes), 0.5 * diameter * np.sqrt(axes)
    posts = np.searchsorted(axis, np.column_stack([y - long, y + long, x - long, x + long]))
    shapes = np.column_stack([x, y, height, long, short, np.cos(yaw), np.sin(yaw)])
    for (south, north, west, east), (cx, cy, high, a, b, cos, sin) in zip(
        posts.tolist(), shapes.tolist(), strict=True
    ):
        dx, dy = axis[None, west:east] - cx, axis[south:north, None] - cy
        along, across = (cos * dx + sin * dy) / a, (cos * dy - sin * dx) / b
        rise = high * np.sqrt(np.maximum(1.0 - along * along - across * across, 0.0))
        part = rocks[south:north, west:east]
        if heaped and part.size:
            middle = part[(north - south) // 2, (east - west) // 2]
            rise = np.where(rise > 0.0, rise + min(0.6 * middle, 0.6), 0.0)
        np.maximum(part, rise, out=part)
