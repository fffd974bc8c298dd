# SPDX-License-Identifier: Apache-2.0
"""Results for other programs, read back by other programs' libraries."""

import json

import numpy as np
import pytest
import yaml
from replay.recordings import GROUND, write_ros2
from replay.test_cli import run

from quadtree_lss.desk.exchange.formats import ExchangeError
from quadtree_lss.desk.exchange.saved import load_results
from quadtree_lss.desk.replay.export import LAYERS, export_results
from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.messages.maps import encode_hazards

pytestmark = pytest.mark.xdist_group("export")  # its flight is made once

#: Of a map about its origin.
MADE_FOR = "+proj=tmerc +lat_0=38 +lon_0=-116 +datum=WGS84 +units=m"


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("export")
    bag = write_ros2(folder / "bag", scans=10)
    return replay(bag, folder / "out", config_from_values(GROUND), report=False)


def test_every_layer_is_a_cloud_optimised_geotiff(written, tmp_path):
    rasterio = pytest.importorskip("rasterio")
    paths = export_results(written.out, tmp_path, ["geotiff"], crs=MADE_FOR)
    grid = load_results(written.out).grid
    names = {*grid.layers, "map_height", "map_deviation"}
    assert {path.name for path in paths} == {f"{name}.tif" for name in names}
    for name, values in grid.layers.items():
        with rasterio.open(tmp_path / f"{name}.tif") as file:
            assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG" and file.crs.is_projected
            assert file.descriptions == (name,) and file.units == (LAYERS[name][0] or None,)
            assert LAYERS[name][1] in file.tags()["TIFFTAG_IMAGEDESCRIPTION"]
            x, y = grid.x[5], grid.y[40]
            (pixel,) = file.sample([(x, y)])
            if values.dtype == np.bool_:
                assert file.nodata == 255
                values = np.where(grid["hazard"] & 128, 255, values)
                assert {0, 1, 255} == set(values.flat)
            np.testing.assert_allclose(pixel[0], np.float32(values[40, 5]))
            np.testing.assert_allclose(file.read(1), values[::-1].astype(file.dtypes[0]))
    with rasterio.open(tmp_path / "map_height.tif") as file:
        side, known = written.cells.domain.finest_size, np.argwhere(written.cells.known)
        corner = np.array((written.cells.domain.xmin, written.cells.domain.ymin))
        for place in known[:: len(known) // 20, ::-1]:
            middle = corner + (place + 0.5) * side
            (pixel,) = file.sample([middle])
            np.testing.assert_allclose(pixel[0], written.cells.at(*middle).height, rtol=1e-6)


@pytest.mark.parametrize("form", ["ply", "gltf"])
def test_the_mesh_is_the_ground(written, tmp_path, form):
    trimesh = pytest.importorskip("trimesh")
    (path,) = export_results(written.out, tmp_path, [form])
    mesh = trimesh.load(path, force="mesh", process=False)
    vertices, normals = np.asarray(mesh.vertices), np.asarray(mesh.face_normals)
    if form == "gltf":  # y up, as glTF has it
        vertices, normals = (v[:, [0, 2, 1]] * (1.0, -1.0, 1.0) for v in (vertices, normals))
    grid = load_results(written.out).grid
    known = np.isfinite(grid["elevation"])
    x, y = np.meshgrid(grid.x, grid.y)
    expected = np.column_stack([x[known], y[known], grid["elevation"][known]])
    assert len(vertices) == len(expected) and (normals[:, 2] > 0.5).all()
    order = np.lexsort(np.round(vertices[:, :2], 3).T)
    np.testing.assert_allclose(vertices[order], expected[np.lexsort(expected[:, :2].T)], atol=1e-5)
    whole = known[1:, 1:] & known[1:, :-1] & known[:-1, 1:] & known[:-1, :-1]
    assert len(mesh.faces) == 2 * np.count_nonzero(whole)
    colours = np.asarray(mesh.visual.vertex_colors)[:, :3]
    assert len(np.unique(colours, axis=0)) > 2


def test_geojson_has_a_place_on_the_earth(written, tmp_path):
    with pytest.raises(ExchangeError, match="longitude and latitude"):
        export_results(written.out, tmp_path, ["geojson"])
    assert not list(tmp_path.iterdir())
    pytest.importorskip("rasterio")
    sites = load_results(written.out).sites
    (path,) = export_results(written.out, tmp_path, ["geojson"], origin=(38.0, -116.0))
    world = json.loads(path.read_text())
    assert set(world) == {"type", "features"}
    points = [f for f in world["features"] if f["properties"]["kind"] == "site"]
    assert len(points) == len(sites["x"]) > 0
    for k, feature in enumerate(points):
        known = feature["properties"]
        assert known["rank"] == k + 1 and known["id"] == sites["id"][k]
        longitude, latitude, z = feature["geometry"]["coordinates"]
        metre = np.radians(6_371_000.0)  # of a degree, on a sphere: to half a per cent
        np.testing.assert_allclose((latitude - 38.0) * metre, sites["y"][k], atol=0.006 * 16)
        east = (longitude + 116.0) * metre * np.cos(np.radians(38.0))
        np.testing.assert_allclose(east, sites["x"][k], atol=0.006 * 16)
        assert z == sites["z"][k]
    for feature in world["features"]:
        if feature["properties"]["kind"] == "zone":
            (ring,) = feature["geometry"]["coordinates"]
            assert ring[0] == ring[-1] and len(ring) == 49


def test_map_server_reads_back_the_occupancy_grids(written, tmp_path):
    """As nav2's map_server does in its mode trinary."""
    export_results(written.out, tmp_path, ["map_server"])
    found = written.assessment
    landing = np.where(found.safe, 0, np.where(found.hazard >= 128, -1, 100))
    for name, expected in (("hazards", encode_hazards(found)), ("landing", landing)):
        told = yaml.safe_load((tmp_path / f"{name}.yaml").read_text())
        content = (tmp_path / told["image"]).read_bytes()
        header, size, most, pixels = content.split(b"\n", 3)
        width, height = map(int, size.split())
        assert header == b"P5" and most == b"255"
        shade = np.frombuffer(pixels, np.uint8).reshape(height, width)[::-1] / 255.0
        occupied = 1.0 - shade
        values = np.full(shape := (height, width), -1)
        values[occupied > told["occupied_thresh"]] = 100
        values[occupied < told["free_thresh"]] = 0
        assert shape == expected.shape
        np.testing.assert_array_equal(values, expected)
        np.testing.assert_allclose(told["origin"][0] + 0.5 * told["resolution"], found.x[0])


def test_the_command_writes_all_of_it(written, tmp_path, capsys):
    for name in ("rasterio", "trimesh"):
        pytest.importorskip(name)
    code, out, _ = run(capsys, "export", written.out, "--out", tmp_path / "all")
    assert code == 0 and "elevation.tif" in out and "files in" in out
    written_now = {path.name for path in (tmp_path / "all").iterdir()}
    assert {"safe.tif", "ground.ply", "ground.glb", "landing.yaml"} <= written_now
    assert "sites.geojson" not in written_now
    place = ["--format", "geojson", "--origin=38,-116"]
    code, out, _ = run(capsys, "export", written.out, *place, "--json", "-q")
    assert json.loads(out)["files"] == [str(written.out / "exchange" / "sites.geojson")]
    code, _, err = run(capsys, "export", written.out, "--format", "geotif")
    assert code == 2 and "try geotiff" in err
    code, _, err = run(capsys, "export", written.out, "--crs", "EPSG:nonsense")
    assert code == 1 and "is not a coordinate reference system" in err and err.count("\n") == 1
    code, _, err = run(capsys, "export", tmp_path)
    assert code == 1 and "replay did not write this folder" in err
