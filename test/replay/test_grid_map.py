# SPDX-License-Identifier: Apache-2.0
"""``landing/grid_map`` in recorded bags, read as grid_map lays it out."""

from __future__ import annotations

import numpy as np
import pytest
from replay.recordings import GROUND, write_ros2
from rosbags.highlevel import AnyReader

from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.onboard.config.settings import config_from_values


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded")
    bag, products = write_ros2(folder / "bag", scans=10), folder / "products"
    result = replay(bag, None, config_from_values(GROUND), record=products)
    with AnyReader([products]) as reader:  # types of the bag's own definitions
        (connection,) = (c for c in reader.connections if c.topic == "/landing/grid_map")
        raws = [raw for _, _, raw in reader.messages([connection])]
        assert connection.msgtype == "grid_map_msgs/msg/GridMap"
        return result, [reader.deserialize(raw, connection.msgtype) for raw in raws]


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


def test_each_layer_has_its_values_at_its_places(recorded):
    result, messages = recorded
    last, found = messages[-1], result.assessment
    assert last.header.frame_id == "map" and "elevation" in last.basic_layers
    names = {"elevation", "plane_elevation", "slope_deg", "hazard", "safe", "score"}
    assert names <= set(last.layers) and len(last.data) == len(last.layers)
    rng = np.random.default_rng(1)
    for row, column in rng.integers(0, found.score.shape, (200, 2)):
        for name in names:
            value = at(last, name, found.x[column], found.y[row])
            expected = np.float32(getattr(found, name)[row, column])
            np.testing.assert_array_equal(value, expected, name)


def test_the_definition_is_that_of_ros_2(recorded):
    """Jazzy's grid_map_msgs: the header stands in GridMap, not in its info."""
    from quadtree_lss.desk.bags.message_types import typestore

    fields = typestore(ros1=False).fielddefs
    names = [name for name, _ in fields["grid_map_msgs/msg/GridMap"][1]]
    assert names == [
        "header",
        "info",
        "layers",
        "basic_layers",
        "data",
        "outer_start_index",
        "inner_start_index",
    ]
    info = [name for name, _ in fields["grid_map_msgs/msg/GridMapInfo"][1]]
    assert info == ["resolution", "length_x", "length_y", "pose"]
