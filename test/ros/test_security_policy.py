# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policy allows exactly what the nodes use, and this has the types of the contracts."""

import time
from pathlib import Path
from xml.etree import ElementTree

import pytest
from replay.test_contracts import used_by

from quadtree_lss.lab.live.processes import program
from quadtree_lss.onboard.nodes.ros_messages import GridMap

pytestmark = pytest.mark.xdist_group("ros_landing")

POLICY = Path(__file__).parents[2] / "security" / "policy.xml"
WAYS = (
    {"mount.source": "gimbal", "use_sim_time": "true"},
    {"pose.source": "odometry", "lidar.source": "depth", "domain.follow": "area"},
)
"""Parameters with which a node subscribes to different topics."""
UNSEEN = {("subscribe", "/tf_static")}
if GridMap is None:
    UNSEEN.add(("publish", "/landing/grid_map"))
"""Their messages come with ROS itself, not with the wheels."""


def allowed(name):
    """(what, full name) of a node's profile; ``what`` as in `used`."""
    profile = ElementTree.parse(POLICY).find(f".//profile[@node='{name}']")
    found = set()
    for group in profile:
        (what,) = group.attrib
        assert group.get(what) == "ALLOW"
        found |= {(what, full_name(item.text, name)) for item in group}
    return found


def full_name(item, node):
    """Full name of a topic or service of a node without namespace."""
    item = item.replace("~", f"/{node}")
    return item if item.startswith("/") else f"/{item}"


def used(node, name):
    """Return what the node uses according to the ROS graph: type by (what, full name)."""
    ask = {
        "publish": node.get_publisher_names_and_types_by_node,
        "subscribe": node.get_subscriber_names_and_types_by_node,
        "reply": node.get_service_names_and_types_by_node,
        "request": node.get_client_names_and_types_by_node,
    }
    return {
        (what, topic): kind for what, names in ask.items() for topic, (kind,) in names(name, "/")
    }


def is_known(node, name):
    return name in node.get_node_names()


def test_a_node_without_its_keys_does_not_start_unprotected(ros):
    secure = {"ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_STRATEGY": "Enforce"}
    ros.env |= {**secure, "ROS_SECURITY_KEYSTORE": str(ros.folder)}
    ended = ros.run(program("lss_node"), "--ros-args", "--enclave", "/quadtree_lss/lss_node")
    assert ended.returncode != 0 and "Traceback" not in ended.stderr
    assert ended.stderr.splitlines()[-1].startswith("error: ") and "SECURITY" in ended.stderr


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mapping_node", "lss_node", "autopilot_node"])
def test_node_uses_exactly_what_the_policy_allows(ros, name):
    seen = {}
    for way in WAYS:
        args = [text for key, value in way.items() for text in ("-p", f"{key}:={value}")]
        process = ros.start(name, *args)
        with ros.listen({}) as listener:
            listener.until(lambda: name in listener.diagnostics)
            listener.until(is_known, listener.node, name)  # it speaks, but has to be announced
            found = None
            while found != used(listener.node, name):  # it is announced piece by piece
                found = used(listener.node, name)
                time.sleep(1.0)
            seen |= found
        process.stop()
    wanted = allowed(name)
    assert seen.keys() - wanted == set(), "missing in security/policy.xml"
    assert wanted - seen.keys() - UNSEEN == set(), "more than needed in security/policy.xml"
    contract = {(what, full_name(item, name)): kind for what, item, kind in used_by(name)}
    different = {key for key, kind in contract.items() if seen.get(key) != kind}
    assert different <= UNSEEN, "missing, or of another type"
