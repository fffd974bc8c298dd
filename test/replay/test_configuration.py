# SPDX-License-Identifier: Apache-2.0
"""Parameter files as ROS has them, offline."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quadtree_lss.desk.commands.config import file_errors
from quadtree_lss.desk.replay.configuration import dump_config, find_config, load_config
from quadtree_lss.onboard.config.settings import ConfigError, config_from_values, parameters

SHIPPED = ("default", "morpheus", "parabola", "parabola_fixed", "flight")


@pytest.fixture
def write(tmp_path):
    def write_file(text, name="file.yaml"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write_file


def section(*lines, node="/**"):
    return f"{node}:\n  ros__parameters:\n" + "".join(f"    {line}\n" for line in lines)


def message(*paths, **overrides):
    with pytest.raises(ConfigError) as caught:
        load_config(paths, overrides)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize("form", ["{}", "{}.yaml", "config/{}.yaml"])
def test_shipped_configurations_are_found_by_name_from_anywhere(name, form, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert find_config(form.format(name)).is_file()
    first = ["parabola"] if name == "parabola_fixed" else []
    assert load_config([*first, form.format(name)]).domain.size > 0.0


def test_later_files_win_and_overrides_win_over_all(write):
    first = write(section("domain.size: 10.0", "lss.margin: 1.0"), "a.yaml")
    second = write(section("domain.size: 20"), "b.yaml")
    config = load_config([first, second])
    assert (config.domain.size, config.lss.margin) == (20.0, 1.0)
    assert load_config([second, first]).domain.size == 10.0
    assert load_config([first], {"domain": {"size": 30.0}}).domain.size == 30.0


def test_files_may_contradict_until_all_are_read(write):
    first = write(section("domain.max_level: 2"), "a.yaml")
    second = write(section("domain.min_level: 1"), "b.yaml")
    assert load_config([first, second]).domain.max_level == 2
    assert str(first) in message(first)


@pytest.mark.parametrize(
    "node", ["/**", "mapping_node", "/mapping_node", "/uav/lss_node", "autopilot_node"]
)
def test_sections_of_each_node_apply(write, node):
    path = write(section("domain.size: 10.0", node=node))
    assert load_config([path]).domain.size == 10.0


@pytest.mark.parametrize(
    ("name", "reaches"),
    [
        *[
            (name, True)
            for name in ("/**", "/*/lss_node", "/**/lss_node", "uav1/lss_node", "/uav1/*")
        ],
        *[
            (name, False)
            for name in ("/*", "lss_node", "/uav1/mapping_node", "(", "/uav12/lss_node")
        ],
    ],
)
def test_a_file_reaches_a_node_as_ros_has_it(write, name, reaches):
    """As the wheels' rclpy gave overrides to a node of this name."""
    path = write(section("domain.size: 10.0", node=name))
    errors = file_errors(path, "/uav1/lss_node")
    assert any("no section is for '/uav1/lss_node'" in line for line in errors) != reaches
    assert reaches or f"it has '/{name.lstrip('/')}'" in errors[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["/**"]),
        ("- 1\n- 2\n", ["/**"]),
        ("domain:\n  size: 3\n", ["ros__parameters"]),
        ("/**:\n  ros__parameters: 3\n", ["no keys"]),
        ("/**: [", ["YAML", "line"]),
        ("/**:\n  ros__parameters:\n    a: 1\n    a: 2\n", ["twice", "line 4"]),
        (section("domain.size: ten"), ["domain.size", "ten"]),
        (section("domain.size: -1.0"), ["domain.size"]),
        (section("domain.size: .nan"), ["domain.size"]),
        (section("lss.sites: 2.5"), ["lss.sites"]),
        (section("lss.assessment: guess"), ["paper", "touchdown"]),
        (section("domain.size: 3", node="maping_node"), ["maping_node", "'mapping_node'"]),
    ],
)
def test_each_mistake_gives_one_clear_line(write, text, words):
    path = write(text)
    found = message(path)
    for word in [str(path), *words]:
        assert word in found


@settings(max_examples=40)
@given(st.data())
def test_what_is_dumped_loads_again(tmp_path_factory, data):
    values = {}
    for row in data.draw(st.lists(st.sampled_from(parameters()), unique_by=lambda r: r.name)):
        if row.choices:
            values[row.name] = data.draw(st.sampled_from(row.choices))
        elif row.type is bool:
            values[row.name] = data.draw(st.booleans())
        elif row.type is str:
            values[row.name] = data.draw(st.text("abc: #'\"/-_ö1", min_size=1))
        elif row.type is float:
            values[row.name] = data.draw(st.floats(row.low, row.high))
    try:
        config = config_from_values(values)
    except ConfigError:
        return  # values that contradict one another
    path = Path(tmp_path_factory.mktemp("dump")) / "c.yaml"
    for comments in (False, True):
        path.write_text(dump_config(config, comments=comments))
        assert load_config([path]) == config


LAUGHS = "a: &a [x, x, x]\n" + "".join(
    f"{chr(98 + k)}: &{chr(98 + k)} [{', '.join([f'*{chr(97 + k)}'] * 9)}]\n" for k in range(9)
)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        (LAUGHS, "aliases"),
        (section("domain: &d {size: 10.0}", "lss: *d"), "aliases"),
        (section("<<: {domain.size: 10.0}"), "merge"),
        (section(f"domain.size: {'[' * 20000}"), "deep"),
        (section(f"domain.size: {'9' * 5000}"), "digits"),
        (section("domain.size: 2020-13-45"), "month"),
        (section("domain.size: !!timestamp x"), "YAML"),
        (section("? [a]", ": 3"), "YAML"),
        (section(f"frames.map: {'m' * 2**20}"), "the most"),
    ],
)
def test_yaml_that_means_more_than_it_holds_is_refused_at_once(write, text, word):
    line = message(write(text))
    assert word in line and len(line) < 1100
