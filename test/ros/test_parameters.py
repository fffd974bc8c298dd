# SPDX-License-Identifier: Apache-2.0
"""ROS parameters of a node."""

import pytest
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from quadtree_lss.onboard.config.settings import ConfigError, parameters, values_from_config
from quadtree_lss.onboard.nodes.parameters import NodeParameters

pytestmark = pytest.mark.xdist_group("ros")


POSE_QOS = "qos_overrides__/nav/pose__subscription__"
#: Whoever might set these could overwrite, or have read, any file that the node may.
WRITTEN = ("map_file.path", "checkpoint.path")
TOLD_QOS = POSE_QOS.replace("__", ".")


def make_node(context: Context, **overrides: object) -> Node:
    """Create a node with overrides; double underscores in names stand for dots."""
    given = [Parameter(name.replace("__", "."), value=value) for name, value in overrides.items()]
    how = {"context": context, "parameter_overrides": given}
    return Node("node", **how, automatically_declare_parameters_from_overrides=True)


def test_every_row_is_declared_with_type_range_and_access(context):
    node = make_node(context)
    config = NodeParameters(node, print, "lss_node").config
    values = values_from_config(config)
    for row in parameters():
        assert node.get_parameter(row.name).value == values[row.name] == row.default
        described = node.describe_parameter(row.name)
        assert described.read_only is not row.live
        assert row.doc in described.description
        ranges = [*described.integer_range, *described.floating_point_range]
        assert all(r.from_value == row.low and r.to_value == row.high for r in ranges)


def test_overrides_reach_the_configuration_and_integers_serve_as_floats(context):
    node = make_node(context, domain__size=64, lss__sites=2, use_sim_time=True)
    config = NodeParameters(node, print, "lss_node").config
    assert config.domain.size == 64.0 and config.lss.sites == 2
    assert node.get_parameter("domain.size").value == 64.0
    assert node.get_parameter("use_sim_time").value is True


@pytest.mark.quick("lss_node")
@pytest.mark.parametrize("name", ["mapping_node", "lss_node"])
def test_parameter_file_without_a_section_for_the_node_is_an_error(ros, name):
    ros.params.write_text(f"{name}:\n  ros__parameters:\n    lss.margin: 1.0\n")
    node = ros.start(name, "-r", "__ns:=/uav1")
    assert node.process.wait(60.0) == 78
    (line,) = node.output().splitlines()
    assert f"no section is for '/uav1/{name}'" in line and f"it has '/{name}'" in line


def test_unused_qos_overrides_are_logged(ros):
    """It is not an error, because both nodes may share a file."""
    wrong = "qos_overrides./nav/poses.subscription.depth:=4"
    right = "qos_overrides./nav/pose.subscription.depth:=4"
    node = ros.start("mapping_node", "-p", wrong, "-p", right)
    told = (
        "/nav/poses.subscription.* has no effect: this node has no subscription of it, but of"
        " /lidar/points, /nav/pose\n"
    )
    with ros.listen() as listener:
        listener.until(lambda: told in node.output())
    assert node.output().count("has no effect") == 1


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"lss__marign": 1.0}, ["lss.marign", "lss.margin"]),
        ({"mapping__divide_area": 0.1}, ["mapping.divide_area was removed", "the vehicle"]),
        ({"prior__file": "dem.tif"}, ["prior.file was removed", "delete the line"]),
        ({"domain__min_level": 9, "domain__max_level": 8}, ["min_level", "max_level"]),
        ({"checkpoint__path": "/"}, ["checkpoint.path", "'/'"]),
        ({"map_file__path": "maps/."}, ["map_file.path", "not the name of a file"]),
        ({f"{POSE_QOS}reliability": "nonsense"}, [TOLD_QOS + "reliability", "best_effort"]),
        ({f"{POSE_QOS}depth": -3}, [TOLD_QOS + "depth", "-3"]),
        ({f"{POSE_QOS}depth": "abc"}, [TOLD_QOS + "depth", "'abc'"]),
        ({f"{POSE_QOS}reliabilty": "reliable"}, ["reliabilty", f"'{TOLD_QOS}reliability'"]),
        (
            {"qos_overrides__/nav/pose__depth": 5},
            ["unknown", "'qos_overrides./nav/pose.", "depth'"],
        ),
    ],
)
def test_wrong_overrides_are_one_line_errors(context, overrides, words):
    node = make_node(context, **overrides)
    with pytest.raises(ConfigError) as caught:
        NodeParameters(node, print, "lss_node")
    text = str(caught.value)
    assert "\n" not in text
    assert all(word in text for word in words)


def test_only_live_parameters_change(context):
    node = make_node(context)
    seen = []
    held = NodeParameters(node, seen.append, "lss_node")
    (done,) = node.set_parameters([Parameter("lss.margin", value=1.5)])
    assert done.successful
    assert held.config.lss.margin == 1.5 and seen == [held.config]
    for name, value, why in (
        ("domain.size", 10.0, "read-only"),
        ("lss.margin", -1.0, "lss.margin"),
        ("lss.margin", "wide", "type"),
        *((name, "elsewhere", "read-only") for name in WRITTEN),
    ):
        (done,) = node.set_parameters([Parameter(name, value=value)])
        assert not done.successful and why in done.reason
    assert held.config.lss.margin == 1.5 and len(seen) == 1


def test_live_change_without_effect_is_rejected(context):
    node = make_node(context)
    held = NodeParameters(node, print, "mapping_node")
    for name, value, owner in (
        ("lss.margin", 2.0, "lss_node"),
        ("autopilot.reach", 9.0, "autopilot"),
    ):
        (done,) = node.set_parameters([Parameter(name, value=value)])
        assert not done.successful and f"has an effect in {owner}" in done.reason
    margin = held.config.lss.margin
    done = node.set_parameters([Parameter("lss.margin", value=margin)])  # of a file that is loaded
    done += node.set_parameters([Parameter("diagnostics.warn_age", value=2.0)])
    assert all(one.successful for one in done) and held.config.diagnostics.warn_age == 2.0
