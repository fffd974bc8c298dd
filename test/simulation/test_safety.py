# SPDX-License-Identifier: Apache-2.0
"""The contact simulation against plain loops and on ground whose answer is known."""

import itertools

import numpy as np
import pytest

from quadtree_lss.lab.simulation.safety import LandingGear, contact_safe, safety_map, worst_contact
from quadtree_lss.lab.simulation.terrain import Terrain

TAN_LIMIT = np.tan(np.radians(10.0))


def _interpolated(x, y, z, px, py):
    i = min(max(int(np.searchsorted(x, px, side="right")) - 1, 0), x.size - 2)
    j = min(max(int(np.searchsorted(y, py, side="right")) - 1, 0), y.size - 2)
    fu, fv = (px - x[i]) / (x[i + 1] - x[i]), (py - y[j]) / (y[j + 1] - y[j])
    return (1 - fv) * ((1 - fu) * z[j, i] + fu * z[j, i + 1]) + fv * (
        (1 - fu) * z[j + 1, i] + fu * z[j + 1, i + 1]
    )


def brute_force(x, y, z, px, py, lander):
    """One place, one yaw, one set of three pads at a time; planes by solving three equations.

    Tangent of the worst slope, and the worst rise of the ground above a plane.
    """
    slope, rise = 0.0, -np.inf
    radius = lander.diameter / 2
    gx, gy = np.meshgrid(x, y)
    footprint = (gx - px) ** 2 + (gy - py) ** 2 <= (radius + 1e-9) ** 2
    for yaw in range(lander.yaws):
        angles = (yaw / lander.yaws + np.arange(4)) * np.pi / 2
        pads = []
        for angle in angles:
            cx, cy = px + radius * np.cos(angle), py + radius * np.sin(angle)
            under = (gx - cx) ** 2 + (gy - cy) ** 2 <= (lander.pad_radius + 1e-9) ** 2
            highest = max([_interpolated(x, y, z, cx, cy), *z[under]])
            pads.append((cx, cy, highest))
        for three in itertools.combinations(range(4), 3):
            (fourth,) = set(range(4)) - set(three)
            system = np.array([[1.0, pads[k][0] - px, pads[k][1] - py] for k in three])
            plane = np.linalg.solve(system, [pads[k][2] for k in three])
            fx, fy, ground = pads[fourth]
            if ground > plane @ [1.0, fx - px, fy - py] + 1e-12:
                continue  # the fourth pad would stand in the ground
            slope = max(slope, np.hypot(plane[1], plane[2]))
            over = z - (plane[0] + plane[1] * (gx - px) + plane[2] * (gy - py))
            rise = max(rise, over[footprint].max())
    return slope, rise


def _ground(generator, x, y):
    """Rocks of many sizes on a gentle slope: some places safe, some not, many close to a limit."""
    z = 0.06 * x[None, :] + 0.02 * generator.standard_normal((y.size, x.size))
    for _ in range(14):
        cx, cy = generator.uniform(x[0], x[-1]), generator.uniform(y[0], y[-1])
        radius = generator.uniform(0.1, 0.4)
        squared = (x[None, :] - cx) ** 2 + (y[:, None] - cy) ** 2
        z += np.sqrt(np.maximum(radius**2 - squared, 0.0))
    return z


@pytest.mark.parametrize(("seed", "post"), [(0, 0.1), (1, 0.1), (2, 0.094), (3, 0.25), (4, 0.5)])
def test_equals_brute_force(seed, post):
    generator = np.random.default_rng(seed)
    x = -5.0 + post * np.arange(int(10.0 / post) + 1)
    y = -4.5 + post * np.arange(int(9.0 / post) + 1)
    z = _ground(generator, x, y)
    lander = LandingGear(yaws=6)
    grid_x, grid_y = np.arange(-2.5, 2.6, 0.5), np.arange(-2.0, 2.1, 0.5)
    points = [(px, py) for py in grid_y for px in grid_x]
    slow = np.array([brute_force(x, y, z, px, py, lander) for px, py in points])
    dem = Terrain(x, y, z)
    found = np.stack(worst_contact(dem, points, lander), axis=1)
    np.testing.assert_allclose(found, slow, rtol=0.0, atol=1e-9)
    safe = safety_map(dem, grid_x, grid_y, lander)
    np.testing.assert_array_equal(
        safe.ravel(), (slow[:, 0] <= TAN_LIMIT) & (slow[:, 1] <= lander.max_roughness)
    )
    assert 0.05 < safe.mean() < 0.98


def test_reaching_over_the_edge_is_unsafe():
    axis = np.linspace(-6.0, 6.0, 121)
    flat, places = (
        Terrain(axis, axis, np.zeros((121, 121))),
        [(4.0, -4.0), (4.01, 0.0), (50.0, 0.0)],
    )
    assert contact_safe(flat, places).tolist() == [True, False, False]
