# SPDX-License-Identifier: Apache-2.0
"""A prior in mapping_node: what it says of it, and that it maps without one it cannot use."""

import numpy as np
import pytest
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from ros_scene import Sensors

from quadtree_lss.lab.live.listener import TOPICS
from quadtree_lss.onboard.messages.maps import PRIOR_STATUS_FIELDS
from quadtree_lss.onboard.messages.outputs import cloud_records

pytestmark = pytest.mark.xdist_group("ros_faults")
MORE = {"map/prior": PoseWithCovarianceStamped, "map/look_first": PoseArray}


def test_the_node_says_where_to_look_and_how_far_the_map_lies(ros):
    """The scene's ground rises by 2 % along x and has one block; the prior lies 0.7 m lower."""
    axis = 2.0 * np.arange(-30, 31)
    z = 0.02 * axis + np.zeros((61, 1)) - 0.7
    np.savez(ros.folder / "prior.npz", x=axis, y=axis, elevation=z)
    given = ["-p", f"prior.file:={ros.folder / 'prior.npz'}", "-p", "prior.offset_sigma:=2.0"]
    ros.start("mapping_node", *given), ros.start("lss_node", *given)
    with ros.listen({**TOPICS, **MORE}) as listener:
        listener.until(lambda: "map/look_first" in listener.newest)
        assert listener.newest["map/look_first"].poses
        Sensors(listener).matched().map(4)
        listener.until(listener.at_least, "prior.cells", 31)
        found = listener.newest["map/prior"].pose
        assert found.pose.position.z == pytest.approx(0.7, abs=0.15)
        assert 0.0 < found.covariance[14] < 0.2 < found.covariance[0] < 5.0
        assert listener.values()["prior.refused"] == ""

        def with_prior():
            status = listener.newest.get("landing/status")
            return status is not None and len(status.fields) == len(PRIOR_STATUS_FIELDS)

        listener.until(with_prior)
        status = cloud_records(listener.newest["landing/status"], PRIOR_STATUS_FIELDS)[0]
        assert status["prior_z"] == pytest.approx(0.7, abs=0.15)
        assert 0.0 < status["prior_zz"] < 0.2 < status["prior_xx"] < 5.0


def test_a_prior_that_cannot_be_used_is_told_and_the_node_maps(ros):
    mapping = ros.start("mapping_node", "-p", "prior.file:=/no/such/prior.tif")
    with ros.sensors({**TOPICS, **MORE}) as (listener, sensors):
        sensors.map(2)
        listener.until(listener.has, "problems.prior", 1)
        assert "prior.cells" not in listener.values()
        assert "no such file" in mapping.output() and "map/prior" not in listener.newest
