# SPDX-License-Identifier: Apache-2.0
"""Landing sites: what is safe, how it is scored and ranked, and what is said when nothing is."""

import dataclasses
from unittest import mock

import numpy as np
import pytest
from core.builders import OWN, configured, mapped, strip
from core.scenes import flat, slope
from scipy.ndimage import distance_transform_edt

from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.geometry.polygons import signed_distance
from quadtree_lss.onboard.core.landing import hazards, score
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.landing.raster import rasterise
from quadtree_lss.onboard.core.landing.result import LandingAssessment
from quadtree_lss.onboard.core.landing.target import Reason
from quadtree_lss.onboard.core.tree.cell_map import CellMap

SMALL = {"size": 16.0, "min_level": 1, "max_level": 5}
#: Such that no zone of these tests touches a lattice of half metres exactly.
RADIUS = 0.95


def small(**lss: object) -> Config:
    """A lander of 1.9 m on a domain of 16 m with leaves down to 0.5 m."""
    values = {"min_separation": 2.0, "grid_spacing": 0.5, "max_gap": 0.6, **lss}
    names = {"diameter", "clearance", "max_slope_deg", *OWN} & values.keys()
    lander = {"diameter": 2.0 * RADIUS, **{name: values.pop(name) for name in names}}
    return configured(domain=SMALL, noise=0.02, vehicle=lander, lss=values)


def obstacles(x, y):
    """Two blocks, a 0.4 m step in the east, a gentle roll."""
    block = 0.5 * ((np.abs(x - 3.25) < 0.5) & (np.abs(y - 4.25) < 0.5))
    block = block + 0.6 * ((np.abs(x - 7.25) < 0.5) & (np.abs(y - 12.25) < 0.5))
    return block + 0.4 * (x > 13.1) + 0.03 * np.sin(0.8 * x + 0.5 * y)


@pytest.fixture(scope="module")
def cells() -> CellMap:
    return mapped(small(), obstacles, density=150.0, scans=2).snapshot()


@pytest.fixture(scope="module")
def level_ground() -> CellMap:
    return mapped(small(), flat(3.0), density=60.0).snapshot()


def assess(cells: CellMap, config: Config, **where: object) -> LandingAssessment:
    return LandingSiteSelector(config).assess(cells, **where)


def to_edge(x, y):
    """Distance to the domain's edge, beyond which nothing is seen."""
    return np.minimum.reduce([x, y, 16.0 - x, 16.0 - y])


def to_bad(x, y, cells: CellMap, config: Config):
    """Distance to a finest cell that the paper's rule avoids."""
    bad = np.argwhere(hazards.avoided_features(cells, config.lss)[cells.leaf_raster()])
    assert len(bad)
    north, east = (0.5 * bad.T + 0.25)[:, :, None, None]  # their middles
    away = np.abs(np.array([x - east, y - north])) - 0.25
    return np.hypot(*np.maximum(away, 0.0)).min(axis=0)


@pytest.mark.parametrize("margin", [0.0, 0.7])
def test_the_papers_rule_keeps_the_zone_off_every_hazardous_cell(cells, margin):
    """Safe where the zone lies inside the domain and touches neither hazard nor unseen ground."""
    config = small(assessment="paper", margin=margin)
    found = assess(cells, config)
    at = np.meshgrid(found.x, found.y)
    clear = np.minimum(to_edge(*at), to_bad(*at, cells, config)) > RADIUS + margin
    np.testing.assert_array_equal(found.safe, clear)
    np.testing.assert_array_equal(np.isfinite(found.score), found.safe)


@pytest.mark.parametrize("margin", [0.0, 0.7, 1.3])
def test_the_margin_keeps_off_points_that_fail_the_touchdown_check(cells, margin):
    failed = assess(cells, small(margin=0.0)).hazard & hazards.TOUCHDOWN > 0
    found = assess(cells, small(margin=margin))
    away = 0.5 * distance_transform_edt(~failed) > max(margin, 1e-9)
    inside = to_edge(*np.meshgrid(found.x, found.y)) > RADIUS + margin
    np.testing.assert_array_equal(found.safe, inside & away)
    assert failed.any()


@pytest.mark.parametrize("assessment", ["touchdown", "probability"])
@pytest.mark.parametrize("margin", [0.0, 0.7])
@pytest.mark.parametrize("spacing", [0.5, 0.35])
def test_hazard_tells_exactly_where_landing_is_excluded(cells, assessment, margin, spacing):
    config = small(assessment=assessment, margin=margin, grid_spacing=spacing, max_risk=0.1)
    found = assess(cells, config)
    excluding = hazards.TOUCHDOWN | hazards.PARTLY_UNOBSERVED | hazards.UNSEEN
    np.testing.assert_array_equal(found.safe, found.hazard & excluding == 0)
    assert (found.hazard & hazards.PARTLY_UNOBSERVED).any()


def densities(cells: CellMap, config: Config) -> np.ndarray:
    """Eq. 58 without the distance term on the finest cells, by the paper's leaf slopes."""
    leaf, lss = cells.leaf_raster(), config.lss
    subscale = rasterise(cells, lss).subscale
    return (
        score.WEIGHT_SLOPE * np.arccos(np.minimum(cells.normal[:, 2], 1.0))[leaf]
        + score.WEIGHT_ROUGHNESS * np.nan_to_num(cells.roughness / cells.size**2)[leaf]
        + score.WEIGHT_SUBSCALE * subscale
    )


def zone_cells(x: float, y: float, zone: float) -> tuple[np.ndarray, np.ndarray]:
    """Finest cells whose centre lies in the zone."""
    centre = 0.5 * (np.arange(32) + 0.5)
    return np.nonzero(np.hypot(centre - x, centre[:, None] - y) <= zone)


def test_the_score_is_the_mean_density_over_the_zone(cells):
    config = small(assessment="paper", margin=0.4)
    with mock.patch.multiple(score, WEIGHT_DISTANCE=0.0, WEIGHT_SUBSCALE=2.0):
        found, density = assess(cells, config), densities(cells, config)
    assert found.safe.any()
    for row, column in np.argwhere(found.safe):
        over = zone_cells(found.x[column], found.y[row], RADIUS + 0.4)
        assert found.score[row, column] == pytest.approx(density[over].mean(), abs=1e-9)


@pytest.mark.parametrize("assessment", ["paper", "touchdown", "probability"])
def test_the_slope_counts_in_radians(assessment):
    config = small(assessment=assessment, max_risk=0.2)  # so few returns
    cells = mapped(config, slope(0.08, -0.06), density=60.0).snapshot()
    others = dict.fromkeys(("WEIGHT_DISTANCE", "WEIGHT_ROUGHNESS", "WEIGHT_SUBSCALE"), 0.0)
    with mock.patch.multiple(score, WEIGHT_SLOPE=2.0, **others):
        found = assess(cells, config)
    assert found.safe[8:-8, 8:-8].all()
    np.testing.assert_allclose(found.score[8:-8, 8:-8], 2.0 * np.arctan(0.1), rtol=0.05)


def test_the_distance_to_the_nearest_hazard_counts_up_to_its_cap(cells):
    """d_H of a cell varies by less than half its diagonal within the cell, so that much error."""
    weight, cap = 0.5, 3.0
    config = small(assessment="paper")
    size = config.vehicle.diameter_ratio
    mine = {"WEIGHT_DISTANCE": weight * size, "DISTANCE_CAP": cap / size}
    others = dict.fromkeys(("WEIGHT_SLOPE", "WEIGHT_ROUGHNESS", "WEIGHT_SUBSCALE"), 0.0)
    with mock.patch.multiple(score, **mine, **others):
        found = assess(cells, config)
    at = np.meshgrid(*[0.5 * np.arange(32) + 0.25] * 2)
    distances = np.minimum(np.minimum(to_edge(*at), to_bad(*at, cells, config)), cap)
    for row, column in np.argwhere(found.safe)[::7]:
        distance = distances[zone_cells(found.x[column], found.y[row], RADIUS)]
        assert found.score[row, column] == pytest.approx(-weight * np.mean(distance), abs=0.1)
    far = found.score[found.safe]
    assert far.min() >= -weight * cap - 1e-9


@pytest.mark.parametrize("assessment", ["paper", "touchdown"])
@pytest.mark.parametrize(("count", "separation"), [(1, 2.0), (5, 2.0), (8, 3.3), (50, 0.0)])
def test_ranking_takes_the_best_that_are_far_enough_apart(cells, assessment, count, separation):
    config = small(assessment=assessment, sites=count, min_separation=separation)
    found = assess(cells, config)
    expected: list[tuple[float, float]] = []
    places = np.argwhere(found.safe)
    for row, column in places[np.argsort(found.score[found.safe], kind="stable")]:
        x, y = found.x[column], found.y[row]
        if all(np.hypot(x - a, y - b) >= separation for a, b in expected):
            expected.append((x, y))
        if len(expected) == count:
            break
    np.testing.assert_array_equal(found.sites.position[:, :2], expected)
    assert (np.diff(found.sites.score) >= 0.0).all()
    assert len(found.sites.reasons) == len(expected)
    assert all(found.sites.reasons)


def test_sites_are_described_by_the_ground_in_their_zone(cells):
    config = small(assessment="paper")
    found = assess(cells, config)
    leaf, sites = cells.leaf_raster(), found.sites
    subscale = rasterise(cells, config.lss).subscale_peak
    rough = np.nan_to_num(cells.roughness / cells.size**2)[leaf]
    for k, (x, y, z) in enumerate(sites.position):
        over = zone_cells(x, y, RADIUS)
        assert sites.roughness[k] == pytest.approx(rough[over].max(), abs=1e-12)
        assert sites.subscale_height[k] == pytest.approx(subscale[over].max(), abs=1e-12)
        clear = min(to_edge(x, y), to_bad(x, y, cells, config)[0, 0]) - RADIUS
        assert sites.hazard_distance[k] == pytest.approx(max(clear, 0.0), abs=1e-9)
        assert abs(z - obstacles(x, y)) < 0.1
        angle = np.degrees(np.arccos(min(sites.normal[k, 2], 1.0)))
        assert sites.slope_deg[k] == pytest.approx(angle, abs=1e-6)


@pytest.mark.parametrize("margin", [0.0, 0.4])
@pytest.mark.parametrize("assessment", ["paper", "touchdown"])
def test_hazard_distance_is_how_far_the_zone_may_move(cells, assessment, margin):
    """From the site itself, wherever the grid puts it: no lattice of half metres here."""
    lss = {"assessment": assessment, "margin": margin, "grid_spacing": 0.35, "sites": 50}
    config = small(hazard_growth=0.0, min_separation=0.0, **lss)
    found = assess(cells, config)
    fine = assess(cells, small(hazard_growth=0.0, assessment=assessment))
    failed = np.argwhere(fine.hazard & hazards.TOUCHDOWN) * 0.5
    assert len(found.sites.score) == 50
    for k, (x, y, _) in enumerate(found.sites.position):
        free = to_edge(x, y) - RADIUS - margin
        if assessment == "paper":
            free = min(free, to_bad(x, y, cells, config)[0, 0] - RADIUS - margin)
        else:
            free = min(free, np.hypot(*(failed - (y, x)).T).min() - margin)
        assert found.sites.hazard_distance[k] == pytest.approx(free, abs=1e-9)


@pytest.mark.parametrize("assessment", ["paper", "touchdown", "probability"])
def test_level_ground_is_safe_wherever_the_zone_fits(level_ground, assessment):
    found = assess(level_ground, small(assessment=assessment, margin=0.5))
    inside = to_edge(*np.meshgrid(found.x, found.y)) > RADIUS + 0.5
    np.testing.assert_array_equal(found.safe, inside)
    assert len(found.sites.score) == 5
    assert (found.sites.slope_deg < 1.0).all()
    np.testing.assert_allclose(found.sites.position[:, 2], 3.0, atol=0.02)
    assert (found.sites.hazard_distance <= to_edge(*found.sites.position[:, :2].T)).all()
    assert (found.sites.hazard_distance > 1.0).all()  # the middle of 16 m is best
    partly = np.where(inside, 0, hazards.PARTLY_UNOBSERVED)
    np.testing.assert_array_equal(found.hazard, partly)


@pytest.mark.parametrize("assessment", ["paper", "touchdown", "probability"])
def test_unseen_ground_is_never_landable(assessment):
    """A strip of five cells of 0.25 m leaves its middle unseen, one of four is bridged."""
    lss = {"assessment": assessment, "grid_spacing": 0.25, "max_gap": 0.6, "max_risk": 0.01}
    config = configured(levels=(6, 6), vehicle={"diameter": 1.9}, lss=lss)
    bridged, broken = (assess(strip(columns), config) for columns in (4, 5))
    assert not (bridged.hazard & hazards.UNSEEN).any()
    seam = broken.hazard & hazards.UNSEEN > 0
    assert seam[:, [32, 33]].all()
    assert not np.delete(seam, [32, 33], axis=1).any()
    assert np.isnan(broken.elevation[seam]).all()
    # The gap spans 7.50 ... 8.75 m; the zone of 0.95 m must not touch it anywhere: what lies
    # under its edge is as unknown as its middle.
    near = (broken.x > 6.55) & (broken.x < 9.7)
    assert not broken.safe[:, near].any()
    assert broken.safe[8:-8, (broken.x > 2.0) & (broken.x < 6.5)].all()


AREA = [(2.0, 6.0), (12.0, 6.0), (12.0, 15.0), (5.0, 15.0)]


def test_the_zone_lies_in_the_landing_area_and_off_the_keep_out(cells):
    keep_out = [(6.0, 6.0), (8.0, 6.0), (8.0, 9.0)]
    free = assess(cells, small(margin=0.3))
    found = assess(cells, small(margin=0.3), area=AREA, keep_outs=[keep_out])
    x, y = np.meshgrid(found.x, found.y)
    zone = RADIUS + 0.3
    allowed = (signed_distance(AREA, x, y) >= zone) & (signed_distance(keep_out, x, y) <= -zone)
    np.testing.assert_array_equal(np.isfinite(found.score), free.safe & allowed)
    np.testing.assert_array_equal(found.score[free.safe & allowed], free.score[free.safe & allowed])
    # The ground itself is as safe as before.
    np.testing.assert_array_equal(found.safe, free.safe)
    assert len(found.sites.score) > 0


@pytest.mark.parametrize("assessment", ["paper", "touchdown"])
def test_a_preferred_point_does_not_change_the_score(cells, assessment):
    config = small(assessment=assessment)
    free, found = assess(cells, config), assess(cells, config, target=(4.0, 12.0))
    np.testing.assert_array_equal(found.score, free.score)
    assert (found.sites.position != free.sites.position).any()


def assert_empty_but_explained(found: LandingAssessment) -> None:
    assert len(found.sites.score) == len(found.sites.reasons) == 0
    assert found.sites.position.shape == found.sites.normal.shape == (0, 3)
    assert not np.isfinite(found.score).any()
    assert found.explanation
    assert "\n" not in found.explanation


@pytest.mark.parametrize(
    "where",
    [
        {"area": [(100.0, 100.0), (130.0, 100.0), (130.0, 130.0)]},
        {"area": [(5.0, 5.0), (6.0, 5.0), (6.0, 6.0)]},
        {"keep_outs": [[(-50.0, -50.0), (50.0, -50.0), (50.0, 50.0), (-50.0, 50.0)]]},
    ],
    ids=["elsewhere", "too small", "all closed"],
)
def test_no_room_is_an_empty_result_that_says_so(level_ground, where):
    found = assess(level_ground, small(), **where)
    assert_empty_but_explained(found)
    assert found.safe.any()
    elsewhere = "x 100 ... 130, y 100 ... 130, lies outside the domain, x 0 ... 16, y 0 ... 16 m"
    assert (elsewhere in found.explanation) == (np.max(where.get("area", 0.0)) > 99.0)


TRIANGLE = [(1.0, 1.0), (15.0, 1.0), (8.0, 15.0)]


@pytest.mark.parametrize(
    ("where", "said"),
    [
        ({"area": [(0.0, 0.0), (1.0, 1.0)]}, "polygon"),
        ({"area": []}, "polygon"),
        ({"area": [(0.0, 0.0), (9.0, np.nan), (9.0, 9.0)]}, "polygon"),
        ({"keep_outs": [[(0.0, 0.0), (np.inf, 1.0), (9.0, 9.0)]]}, "polygon"),
        ({"keep_outs": [[(0.0, 0.0), (1.0, 1.0)]], "area": TRIANGLE}, "polygon"),
        ({"area": [(-1e300, -1e300), (1e300, 0.0), (0.0, 1e300)]}, "polygon"),
        ({"area": [(0.0, 0.0), (1.0,), (3.0, 3.0)]}, "no site"),
        ({"target": (np.nan, 1.0)}, "target"),
        ({"target": (1.0, np.inf)}, "target"),
        ({"target": (1.0,)}, "target"),
        ({"target": (None, 1.0)}, "no site"),
        ({"why_withheld": "landing/keep_out cannot be used"}, "landing/keep_out cannot be used"),
    ],
)
@pytest.mark.parametrize("assessment", ["paper", "touchdown", "probability"])
def test_what_nobody_can_land_by_gives_no_site_and_says_so(level_ground, assessment, where, said):
    """Ignoring an area or a keep-out that cannot be read could land the vehicle in it."""
    selector = LandingSiteSelector(small(assessment=assessment))
    before = selector.assess(level_ground)
    found = selector.assess(level_ground, **where)
    assert_empty_but_explained(found)
    assert said in found.explanation
    np.testing.assert_array_equal(found.safe, before.safe)
    assert len(selector.assess(level_ground).sites.score) == 5


@pytest.mark.parametrize("assessment", ["paper", "touchdown", "probability"])
@pytest.mark.parametrize("name", ["known", "observed"])
def test_planes_without_a_measurement_are_no_ground(level_ground, assessment, name):
    """Planes of which nothing is known, or no finest cell in which a point fell."""
    nothing = np.zeros_like(getattr(level_ground, name))
    cells = dataclasses.replace(level_ground, **{name: nothing})
    found = assess(cells, small(assessment=assessment))
    assert_empty_but_explained(found)
    assert found.selected.reason is Reason.NOTHING_MAPPED
    assert not found.safe.any() and (found.risk == 1.0).all()
    unmapped = hazards.UNMAPPED if name == "known" else 0
    assert (found.hazard == hazards.UNSEEN | unmapped).all()
