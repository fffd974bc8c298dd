# SPDX-License-Identifier: Apache-2.0
"""The rooms of the package: which may import which, so that no two need each other."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
CORE = "core.geometry core.sensing core.tree core.mapping core.landing"
#: The whole order. All but the core also know the package's version and its errors.
MAY_IMPORT = {
    "errors": "",
    "build": "",
    "arrays": "",
    "core.__init__": "build",
    "config": "",
    "core.geometry": "config",
    "core.sensing": "config core.geometry",
    "core.tree": "config core.geometry core.sensing",
    "core.mapping": "config core.geometry core.sensing core.tree",
    "core.landing": "config core.geometry core.sensing core.tree",
    "messages": f"config {CORE}",
    "report": f"config {CORE}",
    "exchange": f"config {CORE}",
    "replay": f"config {CORE} messages report exchange plot build",
    "simulation": "build",
    "flight": f"config {CORE} messages replay report simulation",
    "ros": f"build config {CORE} messages replay flight",
    "evaluation": f"build config {CORE} messages replay report simulation",
    "campaign": "config evaluation flight replay report simulation",
    "commands": "config exchange replay simulation evaluation campaign flight ros",
    "api": f"config {CORE} messages replay",
    "plot": f"{CORE} report",
    "cli": "build commands",
}


def room(module: str) -> str:
    """``quadtree_lss.core.tree.domain`` is in ``core.tree``."""
    parts = module.split(".")[1:]
    return ".".join(parts[: 2 if parts[:1] == ["core"] else 1])


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
            if str(node.module).split(".")[0] == "quadtree_lss":
                yield from (f"{node.module}.{alias.name}" for alias in node.names)
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
        common = {"errors", "arrays"}
        if not here.startswith("core"):
            common |= {"", "__version__"}
        if there not in {*MAY_IMPORT[here].split(), *common}:
            against.add((name, there))
    assert not against


def test_the_order_has_no_circle():
    below: set[str] = set()
    while len(below) < len(MAY_IMPORT):
        ready = {r for r, needs in MAY_IMPORT.items() if set(needs.split()) <= below} - below
        assert ready, f"among {set(MAY_IMPORT) - below}"
        below |= ready


def test_every_room_is_in_the_table():
    package = ROOT / "quadtree_lss"
    modules = (path.relative_to(package).with_suffix("") for path in package.rglob("*.py"))
    assert {room(".".join(("quadtree_lss", *m.parts))) for m in modules} == {
        "__init__",
        *MAY_IMPORT,
    }
