# SPDX-License-Identifier: Apache-2.0
"""Recorded products are what the nodes publish, and a bag of maps gives the same sites."""

import csv
import json

import numpy as np
import pytest
from replay.recordings import GROUND, START, write_ros2
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from quadtree_lss.desk.bags.bag import Bag
from quadtree_lss.desk.replay import record as products
from quadtree_lss.desk.replay.assessments import Assessments
from quadtree_lss.desk.replay.differences import compare_results
from quadtree_lss.desk.replay.export import export_results
from quadtree_lss.desk.replay.files import ReplayError
from quadtree_lss.desk.replay.info import inspect_bag
from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.messages.maps import CELL_FIELDS, SITE_FIELDS, STATUS_FIELDS, encode_score

pytestmark = pytest.mark.xdist_group("record")  # its flight is made once

CONFIG = config_from_values({**GROUND, "publish.rate": 5.0, "publish.lss_rate": 2.0})
MS = 1_000_000
MAPS = {"/map/cells", "/map/observed"}
NAMES = "sites site_table hazards score probability selected status".split()
LANDING = {f"/landing/{name}" for name in NAMES}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded")
    bag = write_ros2(folder / "flight", scans=20)
    result = replay(bag, folder / "out", CONFIG, report=False, record=folder / "products")
    return result, folder / "products"


def messages(path):
    """(topic, time, message) by a reader that is not ours; types of the bag's own definitions."""
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for connection, received, raw in reader.messages():
            yield connection.topic, received, reader.deserialize(raw, connection.msgtype)


def products_of(path, name):
    """Messages of one topic."""
    return [message for topic, _, message in messages(path) if topic == name]


def test_all_products_at_their_rates_in_the_time_of_the_bag(recorded):
    _, path = recorded
    times = {}
    for topic, received, message in messages(path):
        times.setdefault(topic, []).append(received)
        assert message.header.frame_id == "map"
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec <= received
    assert times.keys() == MAPS | LANDING | {"/landing/grid_map"}
    assert times["/landing/grid_map"][-1] == times["/landing/sites"][-1]
    for names, rate in ((MAPS, 5.0), (LANDING, 2.0), ({"/landing/grid_map"}, 1.0)):
        for name in names:
            gaps = np.diff(times[name]) / 1e9
            assert len(gaps) >= 2 and (gaps[:-1] >= 1.0 / rate - 1e-6).all()  # the last at once


def test_the_last_products_are_those_of_the_results(recorded):
    result, path = recorded
    last = {topic: message for topic, _, message in messages(path)}
    cells = np.frombuffer(last["/map/cells"].data.tobytes(), CELL_FIELDS)
    np.testing.assert_array_equal(cells["elevation"], result.cells.z)
    sites = result.assessment.sites
    table = np.frombuffer(last["/landing/site_table"].data.tobytes(), SITE_FIELDS)
    np.testing.assert_allclose(table["score"], sites.score, rtol=1e-6)
    poses = last["/landing/sites"].poses
    np.testing.assert_array_equal(
        [(p.position.x, p.position.y) for p in poses], sites.position[:, :2]
    )
    score = last["/landing/score"]
    assert score.info.width == len(result.assessment.x)
    np.testing.assert_array_equal(score.data, encode_score(result.assessment).ravel())
    np.testing.assert_allclose(
        score.info.origin.position.x + 0.5 * score.info.resolution, result.assessment.x[0]
    )


def test_the_last_map_gets_its_landing_sites(recorded, tmp_path):
    """Of two maps the second is due before the sites of it are."""
    config = config_from_values({**GROUND, "publish.rate": 10.0, "publish.lss_rate": 4.0})
    cells, path = recorded[0].cells, tmp_path / "bag"
    with products.Recorder(path, "map") as recorder:
        assessments = Assessments(config, dict)
        assessments.on_map.append(recorder.map)
        assessments.on_assessment.append(recorder.landing)
        for now in (START, START + 120 * MS):
            assessments.changed()
            assessments.tick(now, lambda: cells)
        assessments.finish(START + 130 * MS, lambda: cells)
    with Bag(path) as bag:
        counts = {topic.name: topic.count for topic in bag.topics}
    assert counts["/map/cells"] == counts["/landing/sites"] == 2


def sites_of(out):
    """Rows of ``sites.csv`` but for the numbers of places: they depend on what was before."""
    with (out / "sites.csv").open(newline="") as file:
        return [{**row, "id": None} for row in csv.DictReader(file)]


def test_a_bag_of_maps_alone_gives_the_same_sites(recorded, tmp_path):
    first, path = recorded
    second = replay(path, tmp_path / "out", CONFIG, record=tmp_path / "again")
    for name in ("cells.npz", "grid.npz"):
        assert (tmp_path / "out" / name).read_bytes() == (first.out / name).read_bytes()
    assert sites_of(tmp_path / "out") == sites_of(first.out)
    assert second.summary["scans"] == 0 and second.summary["maps"] >= 5
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["map_ms_median"] is None
    assert (tmp_path / "out" / "report.html").exists()
    with Bag(tmp_path / "again") as bag:
        assert {topic.name for topic in bag.topics} == LANDING | {"/landing/grid_map"}
    info = inspect_bag(path, CONFIG)
    assert info.works and info.kind == "maps"


@pytest.mark.slow
@pytest.mark.parametrize("finest", [0, 6])
def test_one_leaf_and_one_grid_point_are_a_map_too(tmp_path, finest):
    values = {**GROUND, "domain.min_level": 0, "domain.max_level": finest}
    values |= {"domain.xmin": -4.0, "domain.ymin": -4.0, "lss.grid_spacing": 40.0}
    config = config_from_values({**values, "vehicle.max_slope_deg": 0.2})  # so it is a hazard
    bag = write_ros2(tmp_path / "bag", scans=3)
    out, path = tmp_path / "out", tmp_path / "recorded"
    first = replay(bag, out, config, record=path)
    assert len(first.cells.level) == first.assessment.safe.size == 1
    again = replay(path, tmp_path / "again", config, report=False)
    assert again.cells.z == first.cells.z
    found = compare_results(out, tmp_path / "again")
    assert found.heights.rms == 0.0
    assert len(export_results(out, formats=["ply", "gltf", "map_server"])) == 6


def test_an_existing_bag_is_not_overwritten(recorded, tmp_path):
    bag = write_ros2(tmp_path / "flight", scans=2)
    before = sorted(p.name for p in bag.iterdir())
    with pytest.raises(ReplayError, match="exists"):
        replay(bag, tmp_path / "out", CONFIG, report=False, record=bag)
    assert sorted(p.name for p in bag.iterdir()) == before


def test_the_target_is_told_in_the_bag_as_in_the_results(recorded):
    result, path = recorded
    told = products_of(path, "/landing/status")
    records = [np.frombuffer(message.data.tobytes(), STATUS_FIELDS)[0] for message in told]
    assert [record["answer"] for record in records] == list(range(1, len(records) + 1))
    assert (np.array([record["age"] for record in records]) >= 0.0).all()
    assert records[-1]["doubts"] == len(result.assessment.warnings)
    with (result.out / "selected.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["id"]) for row in rows] == [change.id for change in result.targets]
    assert rows[0]["reason"] == "first" and int(rows[-1]["id"]) == records[-1]["id"] > 0
    last = products_of(path, "/landing/selected")[-1].pose.pose.position
    target = result.assessment.selected.position
    np.testing.assert_array_equal([last.x, last.y, last.z], target)
    with (result.out / "sites.csv").open(newline="") as file:
        ids = [int(row["id"]) for row in csv.DictReader(file)]
    np.testing.assert_array_equal(ids, result.assessment.sites.id)


def at(message, name, x, y):
    """Value at a place: grid_map's index counts down from the greatest x and y, by columns."""
    info = message.info
    i = int((info.pose.position.x + 0.5 * info.length_x - x) / info.resolution)
    j = int((info.pose.position.y + 0.5 * info.length_y - y) / info.resolution)
    layer = message.data[message.layers.index(name)]
    columns, rows = layer.layout.dim
    assert (columns.label, rows.label) == ("column_index", "row_index")
    assert columns.stride == columns.size * rows.size and rows.stride == rows.size
    return layer.data[j * rows.size + i]


def test_each_layer_of_the_grid_map_has_its_values_at_its_places(recorded):
    result, path = recorded
    (*_, last), found = products_of(path, "/landing/grid_map"), result.assessment
    assert last.header.frame_id == "map" and "elevation" in last.basic_layers
    names = {"elevation", "plane_elevation", "slope_deg", "hazard", "safe", "score"}
    assert names <= set(last.layers) and len(last.data) == len(last.layers)
    rng = np.random.default_rng(1)
    for row, column in rng.integers(0, found.score.shape, (200, 2)):
        for name in names:
            value = at(last, name, found.x[column], found.y[row])
            expected = np.float32(getattr(found, name)[row, column])
            np.testing.assert_array_equal(value, expected, name)
