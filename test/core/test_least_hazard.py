# SPDX-License-Identifier: Apache-2.0
"""The least hazard: in the simulator's contact, in derived lengths, on a map."""

import dataclasses

import numpy as np
import pytest
from core.builders import BY_RISK, configured, mapped

from quadtree_lss.lab.simulation.safety import LandingGear, contact_safe
from quadtree_lss.lab.simulation.terrain import Terrain
from quadtree_lss.onboard.config.vehicle import Lengths, VehicleConfig
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector

#: Not of the least hazard: of the diameter, of the slope, and a rise over the pads' plane.
OTHERS = {"grid_spacing", "min_separation", "max_gap", "hazard_growth", "reference_size"}
OTHERS |= {"touchdown_slope_deg", "touchdown_roughness"}


def block(high: float, wide: float, x: float, y: float):
    """Level ground, and one square block on it."""

    def surface(at_x, at_y):
        on = (np.abs(at_x - x) < 0.5 * wide) & (np.abs(at_y - y) < 0.5 * wide)
        return high * on.astype(np.float64)

    return surface


@pytest.mark.parametrize("clearance", [0.05, 1.0])
@pytest.mark.parametrize("slope", [6.0, 10.0, 15.0])
def test_block_under_one_pad_fails_above_the_least_hazard(slope, clearance):
    vehicle = VehicleConfig(2.0, clearance, slope, 0.1)
    gear = LandingGear(2.0, 0.1, slope, clearance)
    posts = np.linspace(-2.0, 2.0, 201)
    points = np.stack(np.meshgrid(posts[::5], posts[::5]), axis=-1).reshape(-1, 2)
    points = points[np.hypot(*points.T) < 0.85]
    points = np.vstack([points, 0.0 * points[:1]])
    stands = []
    for share in (0.99, 1.01):
        ground = block(share * vehicle.least_hazard, 0.2, 0.0, 1.0)
        high = Terrain(posts, posts, ground(posts[None], posts[:, None]))
        stands.append(contact_safe(high, points, gear))
    assert stands[0].all()
    assert not stands[1][-1], "its northern pad stands on the block"


def test_lengths_of_rocks_scale_with_the_least_hazard():
    assert VehicleConfig().least_hazard == VehicleConfig().clearance
    assert VehicleConfig().lengths == Lengths()
    high = VehicleConfig(2.0, 0.34, 6.0, 0.1)
    assert high.least_hazard == pytest.approx(0.14864, abs=1e-5)
    low = dataclasses.replace(high, clearance=high.least_hazard)
    steeper = dataclasses.replace(high, max_slope_deg=80.0)
    for item in dataclasses.fields(Lengths):
        of = [getattr(one.lengths, item.name) for one in (high, low, steeper)]
        assert (of[0] == of[1]) == (item.name != "touchdown_roughness")
        assert (of[0] == of[2]) == (item.name in OTHERS - {"touchdown_slope_deg"})


def test_block_that_tilts_the_vehicle_too_far_is_unsafe():
    """Half as high as the clearance, 1.1 of the least hazard, of 600 returns per m^2."""
    config = configured(
        domain={"max_level": 7},
        vehicle={"diameter": 2.0, "clearance": 0.34, "max_slope_deg": 6.0, "pad_radius": 0.1},
        lidar={"range_noise": 0.02, "min_range": 0.1},
        lss={**BY_RISK, "grid_spacing": 0.125, "dispersion": 0.0},
    )
    ground = block(0.165, 0.3, 8.0, 8.0)
    found = LandingSiteSelector(config).assess(mapped(config, ground, density=200.0).snapshot())
    x, y = np.meshgrid(found.x, found.y)
    near = (np.abs(x - 8.0) < 3.0) & (np.abs(y - 8.0) < 3.0)
    posts = np.linspace(3.5, 12.5, 226)
    dem = Terrain(posts, posts, ground(posts[None], posts[:, None]))
    places = np.stack([x[near], y[near]], axis=1)
    stands = contact_safe(dem, places, LandingGear(2.0, 0.1, 6.0, 0.34))
    allowed = found.safe[near]
    assert (~stands).sum() > 150
    # What is left lies at the rim: by the simulator's headings a pad there is just on the block.
    assert allowed[~stands].mean() < 0.15
    assert allowed[stands].mean() > 0.4
