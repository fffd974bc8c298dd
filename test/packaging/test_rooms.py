# SPDX-License-Identifier: Apache-2.0
"""Wings and rooms: which may import which, so that what flies needs neither desk nor lab."""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
#: The whole order: a room, and what it may import; a wing or a group of rooms stands for all in it.
#: All know the package's errors.
ORDER = """
build:
onboard.errors:
onboard.arrays:
onboard.config:
onboard.core.__init__: build
onboard.core.geometry: onboard.config
onboard.core.sensing: onboard.config onboard.core.geometry
onboard.core.tree: onboard.config onboard.core.geometry onboard.core.sensing
onboard.core.mapping: onboard.config onboard.core.geometry onboard.core.sensing
onboard.core.mapping: onboard.core.tree
onboard.core.landing: onboard.config onboard.core.geometry onboard.core.sensing
onboard.core.landing: onboard.core.tree
onboard.messages: onboard.config onboard.core
onboard.autopilot: onboard.config onboard.core onboard.messages
onboard.nodes: build onboard.config onboard.core onboard.messages onboard.autopilot
desk.exchange: onboard.config onboard.core
desk.report: onboard.config onboard.core onboard.messages desk.exchange
plot: onboard.core desk.report
desk.bags: onboard.config onboard.messages
desk.replay: build onboard.config onboard.core onboard.messages desk.report desk.exchange
desk.replay: desk.bags
desk.player: onboard.messages onboard.nodes desk.bags desk.replay
desk.commands: onboard.config onboard.core desk.bags desk.exchange desk.replay desk.report
desk.commands: desk.player
lab.simulation: build desk.exchange onboard.messages
lab.flight: onboard.config onboard.core onboard.messages desk.report desk.bags desk.replay
lab.flight: desk.exchange lab.simulation
lab.live: onboard.config onboard.core onboard.messages onboard.nodes desk.replay desk.player
lab.live: desk.bags desk.exchange lab.flight lab.simulation
lab.evaluation: build onboard.config onboard.core onboard.messages desk.bags desk.replay
lab.evaluation: desk.exchange desk.report lab.simulation
lab.campaign: build onboard.config desk.bags desk.replay desk.report lab.evaluation lab.flight
lab.campaign: lab.simulation
lab.commands: onboard.config desk.commands desk.replay lab.simulation lab.flight lab.live
lab.commands: lab.evaluation lab.campaign
api: onboard.config onboard.core onboard.messages desk.bags desk.replay desk.exchange
cli: build desk.commands lab.commands
start: cli
"""
MAY_IMPORT: dict[str, set[str]] = {}
for _line in ORDER.split("\n")[1:-1]:
    _room, _, _names = _line.partition(":")
    MAY_IMPORT.setdefault(_room, set()).update(_names.split())
WINGS = ("onboard", "desk", "lab")
#: What a vehicle has: a wing that flies needs nothing else.
ON_A_VEHICLE = {"numpy", "scipy", "yaml", "cython", "rclpy"}
ON_A_VEHICLE |= {"pandas"}  # only if a user calls Sites.to_dataframe


def room(module: str) -> str:
    """``quadtree_lss.onboard.core.tree.domain`` is in ``onboard.core.tree``."""
    parts = module.split(".")[1:]
    return ".".join(parts[: 3 if parts[1:2] == ["core"] else 2 if parts[:1] != ["build"] else 1])


def allowed(here: str, there: str) -> bool:
    """Whether a room may import of another."""
    return any(f"{there}.".startswith(f"{name}.") for name in MAY_IMPORT[here])


def imported(path: Path) -> Iterator[str]:
    """Modules of this package that a source needs at run time, and what is taken from them."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".pxd":
        yield from re.findall(r"^\s*(?:from|cimport)\s+(quadtree_lss[\w.]*)", text, re.MULTILINE)
        return
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: imports are absolute"
            module = str(node.module).removeprefix("cython.cimports.")
            if module.split(".")[0] == "quadtree_lss":
                yield from (f"{module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == "quadtree_lss":
                    yield alias.name


def edges() -> Iterator[tuple[str, str, str]]:
    """(file, its room, room that it imports) wherever these two differ."""
    package = ROOT / "quadtree_lss"
    for path in sorted([*package.rglob("*.py"), *package.rglob("*.pxd")]):
        name = path.relative_to(package)
        here = room(".".join(("quadtree_lss", *name.with_suffix("").parts)))
        for module in imported(path):
            there = room(module)
            if there != here:
                yield str(name), here, there


def test_rooms_import_only_what_stands_below_them():
    against = set()
    for name, here, there in edges():
        common = {"onboard.errors", "onboard.arrays"}
        if not here.startswith("onboard.core"):
            common |= {"", "__version__"}
        if there not in common and not allowed(here, there):
            against.add((name, there))
    assert not against


def test_no_wing_needs_the_one_above_it():
    for here in MAY_IMPORT:
        for there in MAY_IMPORT[here]:
            wing, below = here.partition(".")[0], there.partition(".")[0]
            if wing in WINGS and below in WINGS:
                assert WINGS.index(below) <= WINGS.index(wing), f"{here} needs {there}"


def test_what_flies_imports_what_a_vehicle_has():
    """At the top of a module or inside of a function: NumPy, SciPy, PyYAML, rclpy and messages."""
    lacks = set()
    for path in sorted((ROOT / "quadtree_lss" / "onboard").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [str(node.module)]
            for name in (n.partition(".")[0] for n in names):
                of_ros = name.endswith(("_msgs", "_interfaces", "_srvs")) or name == "rpyutils"
                known = {*sys.stdlib_module_names, *ON_A_VEHICLE, "quadtree_lss"}
                if not of_ros and name not in known:
                    lacks.add((str(path.relative_to(ROOT)), name))
    # In a function, which the two nodes never call.
    assert lacks == {("quadtree_lss/onboard/autopilot/link.py", "pymavlink")}


def test_the_order_has_no_circle():
    below: set[str] = set()
    while len(below) < len(MAY_IMPORT):
        left = set(MAY_IMPORT) - below
        ready = {a for a in left if not any(a != b and allowed(a, b) for b in left)}
        assert ready, f"among {left}"
        below |= ready


def test_every_room_is_in_the_table():
    package = ROOT / "quadtree_lss"
    modules = (path.relative_to(package).with_suffix("") for path in package.rglob("*.py"))
    rooms = {room(".".join(("quadtree_lss", *m.parts))) for m in modules}
    assert rooms == {"__init__", *(f"{wing}.__init__" for wing in WINGS), *MAY_IMPORT}
