# SPDX-License-Identifier: Apache-2.0
"""What guidance asks for, before and after the map's frame is known."""

from types import SimpleNamespace

from quadtree_lss.onboard.messages.landing_inputs import AREA, LandingRequests

CORNERS = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)]


def message(corners, frame="map", number=None):
    polygon = SimpleNamespace(points=[SimpleNamespace(x=x, y=y, z=0.0) for x, y in corners])
    if number is not None:
        polygon = SimpleNamespace(polygon=polygon, id=number)
    return SimpleNamespace(header=SimpleNamespace(frame_id=frame), polygon=polygon)


def test_what_was_heard_before_the_maps_frame_is_known_counts_by_its_frame():
    requests = LandingRequests(None)
    requests.use_message(AREA, message(CORNERS))
    assert not requests.use_frame("map") and requests.values[AREA].shape == (3, 2)
    assert "frame" in str(requests.use_frame("odom")[AREA]) and requests.values[AREA] is None
    assert "landing/area" in requests.why_withheld
