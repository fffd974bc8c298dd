# SPDX-License-Identifier: Apache-2.0
"""The installed package is what ROS and pip expect, and the same as the checkout."""

import ast
import importlib.metadata
import importlib.util
import os
import re
import stat
import subprocess
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from installed import PREFIX, SHARE

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.onboard.messages import outputs
from quadtree_lss.onboard.messages.maps import CELL_FIELDS, SITE_FIELDS, STATUS_FIELDS

ROOT = Path(__file__).parents[2]
NODES = ("mapping_node", "lss_node", "autopilot_node")
EXECUTABLES = (*NODES, "replay_bag", "simulate", "evaluate", "quadtree-lss")


def test_installed_files_are_those_of_the_checkout():
    spec = importlib.util.find_spec("quadtree_lss")
    assert spec is not None and spec.origin is not None
    installed = Path(spec.origin).parent
    package = ROOT / "quadtree_lss"
    for source in sorted(
        path for kind in ("py", "pxd", "js", "css", "html") for path in package.rglob(f"*.{kind}")
    ):
        copy = installed / source.relative_to(package)
        assert copy.read_bytes() == source.read_bytes(), f"{copy} is stale: make setup"
    shared = (("launch", "*.launch.py"), ("config", "*.*"), ("rviz", "*.rviz"))
    shared += (("foxglove", "*.json"), ("examples", "*.py"))
    for folder, pattern in shared:
        names = {path.name for path in (ROOT / folder).glob(pattern)}
        assert names and names == {path.name for path in (SHARE / folder).glob(pattern)}


def test_ament_index_knows_the_package(monkeypatch):
    pytest.importorskip("rclpy")
    packages = pytest.importorskip("ament_index_python.packages")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(PREFIX))
    assert Path(packages.get_package_prefix("quadtree_lss")) == PREFIX
    assert Path(packages.get_package_share_directory("quadtree_lss")) == SHARE


@pytest.mark.parametrize("name", EXECUTABLES)
def test_executable_is_found_by_ros_and_helps(name, tmp_path):
    if name in NODES:
        pytest.importorskip("rclpy")
    path = PREFIX / "lib" / "quadtree_lss" / name
    assert path.stat().st_mode & stat.S_IXUSR
    env = {**os.environ, "ROS_LOG_DIR": str(tmp_path)}
    done = subprocess.run([path, "--help"], env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "usage" in done.stdout


def test_manifest_has_what_colcon_and_rosdep_read():
    manifest = ElementTree.parse(ROOT / "package.xml").getroot()
    assert manifest.get("format") == "3"
    text = {tag: manifest.findtext(tag) for tag in ("name", "version", "license", "description")}
    assert all(text.values())
    assert text["version"] == importlib.metadata.version("quadtree_lss")
    maintainer = manifest.find("maintainer")
    assert maintainer is not None
    assert re.fullmatch(r"[\w.+-]+@[\w-]+\.[\w.-]+", maintainer.get("email", ""))
    assert manifest.findtext("export/build_type") == "ament_python"


def test_manifest_names_every_ros_package_that_is_imported():
    manifest = ElementTree.parse(ROOT / "package.xml").getroot()
    depends = {item.text for item in manifest.findall("exec_depend")}
    ours = [*(ROOT / "quadtree_lss").rglob("*.py"), *(ROOT / "launch").glob("*.py")]
    ours += (ROOT / "examples").glob("*.py")
    imported = {name for path in ours for name in _imports(path)}
    of_ros = {n for n in imported if n.endswith(("_msgs", "_interfaces")) or n == "rclpy"}
    of_ros |= imported & {"launch", "launch_ros"}
    of_ros |= {kind.partition("/")[0] for kind in outputs.TOPIC_TYPES.values()}
    of_ros.discard("grid_map_msgs")  # nobody must have it
    assert of_ros and of_ros <= depends, f"package.xml lacks {of_ros - depends}"


def test_only_nodes_player_and_live_systems_import_ros():
    rooms = {"onboard/nodes", "desk/player", "lab/live"}
    for path in sorted((ROOT / "quadtree_lss").rglob("*.py")):
        inside = path.relative_to(ROOT / "quadtree_lss").parent.as_posix() in rooms
        names = {n for n in _imports(path) if n == "rclpy" or n.endswith("_msgs")}
        assert inside or not names, f"{path} imports {names}"


def _imports(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module.split(".")[0])
    return names


@pytest.mark.parametrize("path", sorted((ROOT / "config").glob("*.yaml")), ids=lambda p: p.name)
def test_shipped_configurations_are_valid(path):
    load_config([SHARE / "config" / path.name])


@pytest.mark.parametrize(
    ("document", "fields"),
    [
        ("map_cells.md", CELL_FIELDS),
        ("landing_site_table.md", SITE_FIELDS),
        ("landing_status.md", STATUS_FIELDS),
    ],
)
def test_every_field_is_documented_with_its_type(document, fields):
    text = (ROOT / "msg_docs" / document).read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (\w+) \|", text, flags=re.MULTILINE)
    assert rows == [(name, fields[name].name) for name in fields.names]
