# SPDX-License-Identifier: Apache-2.0
"""What guidance asks for, before and after the map's frame is known."""

import tracemalloc
from types import SimpleNamespace

import pytest

from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.landing_inputs import AREA, KEEP_OUTS, LandingRequests

CORNERS = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)]


def message(corners, frame="map", number=None):
    polygon = SimpleNamespace(points=[SimpleNamespace(x=x, y=y, z=0.0) for x, y in corners])
    if number is not None:
        polygon = SimpleNamespace(polygon=polygon, id=number)
    return SimpleNamespace(header=SimpleNamespace(frame_id=frame), polygon=polygon)


def test_polygons_that_cannot_be_used_take_no_memory():
    requests = LandingRequests(None)
    many = message([(1.0, 2.0)] * 5000, number=0)
    tracemalloc.start()
    for number in range(200):
        many = message([(1.0, 2.0)] * 5000, number=number)
        with pytest.raises(MessageError, match="5000 vertices"):
            requests.take(KEEP_OUTS, many)
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 10e6, "less than ten messages"
    wrong = requests.use_frame("map")
    assert len(wrong) == 200 and "5000 vertices" in requests.withheld
    assert "and 197 more" in requests.withheld and len(requests.withheld) < 1000


def test_what_was_heard_before_the_maps_frame_is_known_counts_by_its_frame():
    requests = LandingRequests(None)
    requests.take(AREA, message(CORNERS))
    assert not requests.use_frame("map") and requests.values[AREA].shape == (3, 2)
    assert "frame" in str(requests.use_frame("odom")[AREA]) and requests.values[AREA] is None
    assert "landing/area" in requests.withheld
