# SPDX-License-Identifier: Apache-2.0
"""Entities that the launch file makes from its arguments, with a substitute for `launch`."""

import re
import sys
from contextlib import nullcontext
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest
from installed import PREFIX, SHARE
from launch_stand_in import Context, EmitEvent, Node, RegisterEventHandler, ShutdownProcess, built

from quadtree_lss.onboard.config.settings import parameters
from quadtree_lss.onboard.messages.outputs import TOPIC_TYPES

LAUNCH = SHARE / "launch" / "quadtree_lss.launch.py"
CONTENT = "/**:\n  ros__parameters:\n    lss.margin: 1.0\n"


@pytest.fixture
def make(monkeypatch):
    """Return the nodes by name and the other entities for launch arguments."""

    def nodes(**given: str) -> tuple[dict[str, Any], list[Any]]:
        entities, _ = built(LAUNCH, monkeypatch, **given)
        found = {entity.name: entity for entity in entities if isinstance(entity, Node)}
        return found, [entity for entity in entities if not isinstance(entity, Node)]

    return nodes


def test_both_nodes_start_with_the_shipped_defaults(make):
    nodes, _ = make()
    assert set(nodes) == {"mapping_node", "lss_node"}
    for name, node in nodes.items():
        assert node.package == "quadtree_lss" and node.executable == name
        assert node.parameters == [str(SHARE / "config" / "default.yaml")]
        assert node.remappings == [] and node.ros_arguments == [] and node.namespace == ""
        assert node.respawn is True and node.respawn_delay > 0.0


def test_the_node_that_lands_starts_where_it_is_asked_for(make):
    nodes, _ = make(autopilot="true", config="drone", landing_selected="/a/selected")
    assert set(nodes) == {"mapping_node", "lss_node", "autopilot_node"}
    assert nodes["autopilot_node"].parameters == [str(SHARE / "config" / "drone.yaml")]
    assert nodes["autopilot_node"].remappings == [("landing/selected", "/a/selected")]


def test_a_parameter_file_is_the_only_source_unless_more_is_said(make, tmp_path, monkeypatch):
    """If it is not given, use_sim_time of the file or of a parent applies."""
    (tmp_path / "vehicle.yaml").write_text(CONTENT)
    monkeypatch.chdir(tmp_path)
    path = str(tmp_path / "vehicle.yaml")
    for node in make(params_file="vehicle.yaml")[0].values():
        assert node.parameters == [path]
    for text, value in (("true", True), ("False", False)):
        for node in make(params_file="vehicle.yaml", use_sim_time=text)[0].values():
            assert node.parameters == [path, {"use_sim_time": value}]
    with pytest.raises(RuntimeError, match="use_sim_time is 'maybe'"):
        make(use_sim_time="maybe")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "No such file"),
        (b"", "is empty"),
        (b"# nothing\n", "is empty"),
        (b"\xff\xfe", "cannot be read"),
        (b"a: [", "cannot be read"),
    ],
)
def test_a_file_that_sets_nothing_stops_the_launch(make, tmp_path, monkeypatch, content, words):
    """One line names the path; the nodes do not run with the defaults."""
    monkeypatch.chdir(tmp_path)
    if content is not None:
        (tmp_path / "vehicle.yaml").write_bytes(content)
    with pytest.raises(RuntimeError, match=words) as caught:
        make(params_file="vehicle.yaml")
    assert str(tmp_path / "vehicle.yaml") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_topic_may_be_named(make):
    """The SROS 2 policy has the same topics; another test compares it with the running nodes."""
    used = {}
    for profile in ElementTree.parse(SHARE / "security" / "policy.xml").iter("profile"):
        topics = {item.text for item in profile.iter("topic") if not item.text.startswith("/")}
        used[profile.get("node")] = topics
    given = {topic.replace("/", "_"): f"/vehicle/{topic}" for topic in set().union(*used.values())}
    nodes, _ = make(autopilot="true", **given)
    for name, topics in used.items():
        assert dict(nodes[name].remappings) == {topic: f"/vehicle/{topic}" for topic in topics}


def test_odometry_is_used_when_its_topic_is_named(make):
    nodes, _ = make(nav_odometry="/odometry/filtered")
    assert nodes["mapping_node"].remappings == [("nav/odometry", "/odometry/filtered")]
    assert nodes["mapping_node"].parameters[-1] == {"pose.source": "odometry"}


def test_the_readmes_vehicle_section_names_what_there_is(make):
    """The names in the script exist; its lines were run with the real tools by hand."""
    text = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"<!-- vehicle -->\n```sh\n(.*?)```", text, re.DOTALL)
    lines = [line.partition(" #")[0].split() for block in blocks for line in block.splitlines()]
    names = {row.name for row in parameters()}
    seen = set()
    for words in lines:
        kind = " ".join(words[:2])
        if kind == "ros2 launch":
            given = dict(word.split(":=") for word in words[4:])
            assert given.pop("params_file") == "vehicle.yaml"
            make(**given)
        elif kind == "ros2 run":
            assert (PREFIX / "lib" / words[2] / words[3]).exists()
            for option, value in pairwise(words):
                assert option != "-p" or value.split(":=")[0] in names, value
            remaps = dict(w.split(":=") for o, w in pairwise(words) if o == "--remap")
            assert {name.replace("/", "_"): to for name, to in remaps.items()} == given
        elif kind == "ros2 param":
            assert words[4] in names
        elif kind == "ros2 topic":
            assert words[3].lstrip("/") in TOPIC_TYPES and len(words) == 4
        seen.add(kind)
    assert seen >= {"ros2 launch", "ros2 run", "ros2 param", "ros2 topic"}


@pytest.mark.parametrize(
    ("file", "said"),
    [
        (LAUNCH.name, "no argument 'parms_file'; did you mean 'params_file'?"),
        ("mission.launch.py", None),  # another's, which may have arguments of its own
    ],
)
def test_a_misspelt_argument_stops_the_launch(make, monkeypatch, file, said):
    monkeypatch.setattr(sys, "argv", ["ros2", "launch", "package", file, "parms_file:=a.yaml"])
    with pytest.raises(RuntimeError, match=re.escape(said)) if said else nullcontext():
        make()


@pytest.fixture
def exits(monkeypatch):
    """Report exits to the launch file, run on its own, and return its actions."""
    monkeypatch.setattr(sys, "argv", ["ros2", "launch", str(LAUNCH)])

    def telling(**given: str) -> Any:
        entities, context = built(LAUNCH, monkeypatch, **given)
        context.launch_configurations.clear()  # as of an including file's scope that has ended
        nodes = {entity.name: entity for entity in entities if isinstance(entity, Node)}
        said = next(e.args[0].on_exit for e in entities if isinstance(e, RegisterEventHandler))

        def tell(name: str, code: int, *, ending: bool = False) -> list[Any]:
            context.is_shutdown = ending
            event = SimpleNamespace(returncode=code, process_name=name, action=nodes[name])
            return said(event, context)

        return tell

    return telling


def test_a_launch_of_which_a_node_was_refused_fails(exits):
    """The launch fails when the last node ends; until then the other one is restarted."""
    tell = exits()
    assert tell("lss_node", 78) and tell("lss_node", 78)
    assert not tell("mapping_node", 1)
    with pytest.raises(RuntimeError, match="lss_node ended with exit code 78"):
        tell("mapping_node", 0, ending=True)


def test_it_fails_at_once_if_nothing_goes_on(exits):
    for given, code in (({}, 78), ({"respawn": "false"}, 0), ({"autopilot": "true"}, 78)):
        tell = exits(**given)
        assert tell("lss_node", 78)
        if given == {"autopilot": "true"}:
            assert tell("autopilot_node", 78)
        with pytest.raises(RuntimeError, match="exit code 78"):
            tell("mapping_node", code)


@pytest.mark.parametrize(("code", "final"), [(0, False), (1, False), (-9, False), (2, True)])
def test_a_wrong_configuration_is_not_tried_again(make, code, final):
    nodes, others = make()
    context = Context({})
    handlers = [e.args[0] for e in others if isinstance(e, RegisterEventHandler)]
    assert {handler.target_action.name for handler in handlers} == set(nodes)
    for handler in handlers:
        node = handler.target_action
        event = SimpleNamespace(returncode=code, process_name=node.name, action=node)
        events = [e.event for e in handler.on_exit(event, context) if isinstance(e, EmitEvent)]
        assert len(events) == final
        for end in events:
            assert isinstance(end, ShutdownProcess) and end.process_matcher(node)


def test_the_nodes_exit_code_for_a_wrong_configuration_is_among_the_final_ones(make):
    node_runner = pytest.importorskip("quadtree_lss.onboard.nodes.node_runner")
    test_a_wrong_configuration_is_not_tried_again(make, node_runner.WRONG_CONFIGURATION, True)
