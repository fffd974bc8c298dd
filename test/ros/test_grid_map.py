# SPDX-License-Identifier: Apache-2.0
"""``landing/grid_map`` live, where ``grid_map_msgs`` is installed."""

import numpy as np
import pytest

from quadtree_lss.onboard.nodes.ros_messages import GridMap, message_maker


def test_a_layer_is_a_float_array_of_ros():
    values = np.arange(12.0).reshape(3, 4)
    values[0, 0] = np.nan
    layer = message_maker("map").grid_map_layer(values)
    assert [d.size for d in layer.layout.dim] == [3, 4]
    np.testing.assert_array_equal(layer.data, values[::-1, ::-1].ravel())


@pytest.mark.skipif(GridMap is None, reason="grid_map_msgs is not installed")
def test_the_message_can_be_serialised():
    from rclpy.serialization import deserialize_message, serialize_message

    from quadtree_lss.onboard.config.settings import Config
    from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
    from quadtree_lss.onboard.core.mapping.mapper import Mapper

    nothing = LandingSiteSelector(Config()).assess(Mapper(Config()).snapshot())
    message = message_maker("map").grid_map(nothing)
    again = deserialize_message(serialize_message(message), GridMap)
    assert again.layers == message.layers and again.info.length_x == message.info.length_x
