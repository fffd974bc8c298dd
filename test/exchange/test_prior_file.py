# SPDX-License-Identifier: Apache-2.0
"""``prior.file``: units, places, what is no prior; and what replay and flight make of it."""

import json

import numpy as np
import pytest

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.lab.flight.flight import Flight
from quadtree_lss.lab.flight.settings import flight_settings
from quadtree_lss.onboard.elevation.libraries import ExchangeError
from quadtree_lss.onboard.elevation.prior_file import read_prior
from quadtree_lss.onboard.messages.outputs import status_from_message

STEP = 2.0


def config(file, **how):
    values = {"domain.xmin": -20.0, "domain.ymin": -20.0, "domain.size": 40.0}
    prior = {f"prior.{key}": value for key, value in ({"file": str(file)} | how).items()}
    return load_config(overrides=values | prior)


def tiff(path, crs="EPSG:32611", unit=None):
    """Heights x / 10 - y / 5 about 500 km, 4000 km, 120 x 120 m; one post unknown."""
    rasterio = pytest.importorskip("rasterio")
    axis = STEP * np.arange(-30, 31)
    z = 0.1 * axis[None, :] - 0.2 * axis[:, None]
    z[0, 0] = -9999.0
    west, north = 500_000.0 + axis[0] - 1.0, 4_000_000.0 + axis[-1] + 1.0
    grid = rasterio.Affine(STEP, 0.0, west, 0.0, -STEP, north)
    how = {"width": 61, "height": 61, "count": 1, "dtype": "float64", "nodata": -9999.0}
    with rasterio.open(path, "w", driver="GTiff", crs=crs, transform=grid, **how) as file:
        file.write(z[::-1], 1)
        if unit:
            file.units = [unit]
    return path


def test_no_file_is_no_prior():
    assert read_prior(load_config()) is None


@pytest.mark.parametrize(("unit", "metres"), [(None, 1.0), ("ft", 0.3048)])
def test_a_geotiff_lies_about_the_origin_in_metres(tmp_path, unit, metres):
    """The place of the corner's zone is found independently, by another transformation."""
    warp = pytest.importorskip("rasterio.warp")
    (east,), (north,) = warp.transform("EPSG:32611", "EPSG:4326", [500_000.0], [4_000_000.0])
    file = tiff(tmp_path / "prior.tif", unit=unit)
    prior = read_prior(config(file, origin=f"{north},{east}"))
    x, y = np.meshgrid(prior.x, prior.y)
    near = np.hypot(x, y) < 30.0
    assert near.sum() > 600 and np.ptp(prior.x) == pytest.approx(STEP * (len(prior.x) - 1))
    # On the central meridian, whose scale is 0.9996, and where north is north.
    np.testing.assert_allclose(
        prior.elevation[near], metres * (0.1 * x - 0.2 * y)[near] * 0.9996, atol=0.02 * metres
    )
    assert np.isnan(prior.elevation).any()
    here = read_prior(config(file))
    assert here.x.mean() == pytest.approx(500_000.0) and here.elevation.shape == (61, 61)


@pytest.mark.parametrize(
    ("make", "how", "word"),
    [
        (lambda p: tiff(p / "a.tif"), {"origin": "here"}, "'here' is no LAT,LON"),
        (lambda p: tiff(p / "a.tif"), {"origin": "95,0"}, "no LAT,LON"),
        (lambda p: tiff(p / "a.tif", crs=None), {"origin": "36,-117"}, "no coordinate system"),
        (lambda p: p / "none.tif", {}, "no such file"),
    ],
)
def test_what_is_no_prior_is_refused_in_a_line(tmp_path, make, how, word):
    with pytest.raises(ExchangeError, match=word) as said:
        read_prior(config(make(tmp_path), **how))
    assert "\n" not in str(said.value)


def test_replay_says_where_to_look_first_and_how_far_the_map_lay(tmp_path):
    from replay.recordings import GROUND, write_ros2
    from replay.test_record import products_of

    from quadtree_lss.desk.exchange.saved import load_results
    from quadtree_lss.desk.replay.replay import replay
    from quadtree_lss.desk.report.headline import trust

    axis = STEP * np.arange(-60, 61)
    np.savez(tmp_path / "prior.npz", x=axis, y=axis, elevation=0.05 * axis + np.full((121, 1), 0.4))
    bag = write_ros2(tmp_path / "bag", scans=6)
    plain = replay(bag, None, load_config(overrides=GROUND), report=False)
    assert "prior" not in plain.summary
    own = {"prior.file": str(tmp_path / "prior.npz"), "prior.sigma": 0.1, "domain.max_level": 4}
    settings, record = load_config(overrides=GROUND | own), tmp_path / "record"
    replay(bag, tmp_path / "out", settings, report=False, record=record)
    told = json.loads((tmp_path / "out" / "summary.json").read_text())["prior"]
    assert told["look_first"][0]["ease"] > 0.9 and told["covered"] == 1.0
    assert told["cells"] > 8 and told["refused"] == ""
    # Along a slope nothing tells east from up, but for the prior of either.
    assert told["up_sigma"] == pytest.approx(0.05 * told["east_sigma"], rel=0.2)
    assert abs(told["up"] + 0.4 - 0.05 * told["east"]) < 0.1
    facts = {fact.name: fact.value for fact in trust(load_results(tmp_path / "out"))[1]}
    assert f"{told['up']:+.2f} ± {told['up_sigma']:.2f} m" in facts["map from its prior, e, n, up"]
    # The bag has it as the nodes say it: as a pose, behind the status, and where to look first.
    (first,), last = products_of(record, "/map/look_first"), products_of(record, "/map/prior")[-1]
    assert first.poses[0].position.x == told["look_first"][0]["x"]
    assert last.pose.pose.position.z == pytest.approx(told["up"])
    status = products_of(record, "/landing/status")[-1]
    assert status_from_message(status)["prior_zz"] == pytest.approx(last.pose.covariance[14])


def test_a_flight_looks_first_where_the_prior_is_even(tmp_path):
    """West of its planned point a cliff is known; the target is asked for in what is looked at."""
    axis = STEP * np.arange(-60, 61)
    z = np.where(axis < 0.0, -1.5 * axis, 0.0) + np.zeros((121, 1))
    np.savez(tmp_path / "prior.npz", x=axis, y=axis, elevation=z)
    own = {"prior.file": str(tmp_path / "prior.npz"), "prior.offset_sigma": 2.0}
    flight = Flight(3, flight_settings({"config": own}))
    first = flight.gimbal.first
    assert first[0] > flight.ground.planned[0] + 4.0
    areas = []
    while flight.gimbal.passes < 2:
        areas += [s.value for s in flight.step() if s.topic == "landing/area"]
    assert 1.0 < flight.time < 3.0 and len(areas[-1]) == 4
    np.testing.assert_allclose(areas[-1].mean(axis=0), first[:2])
    for _ in range(201):
        areas += [s.value for s in flight.step() if s.topic == "landing/area"]
    assert {len(area) for area in areas[:-2]} == {12} == {len(areas[-1])}, "else all in reach"
    assert Flight(3, flight_settings({})).gimbal.first is None
