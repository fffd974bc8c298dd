# SPDX-License-Identifier: Apache-2.0
"""The core is compiled, of the sources beside it, and what is not is refused in one line."""

import ast
import importlib
import os
import shutil
import subprocess
import sys
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

import pytest

import quadtree_lss
from quadtree_lss import build
from quadtree_lss.desk.replay.results import versions

ROOT = Path(__file__).parents[2]
INSTALLED = Path(quadtree_lss.__file__).parent
IMPORT = "import quadtree_lss.onboard.core"


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(INSTALLED.parent).with_suffix("").parts)


def run(code: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Python with the packages of a folder before the installed ones."""
    path = os.pathsep.join([str(folder), str(INSTALLED.parent)])
    env = {"PATH": "/usr/bin:/bin", "PYTHONPATH": path, **environment}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=env, cwd=folder, capture_output=True, text=True, check=False)


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of the installed package."""
    shutil.copytree(INSTALLED, tmp_path / "quadtree_lss")
    return tmp_path


def test_every_kernel_of_the_checkout_is_imported_as_a_binary():
    """What says ``import cython``, and what declares something to other kernels, is one."""
    kernels = {path.relative_to(INSTALLED.parent) for path in build.kernels()}
    sources = [(path.relative_to(ROOT), path) for path in (ROOT / "quadtree_lss").rglob("*.py")]
    says = "import cython"
    assert kernels == {name for name, path in sources if says in path.read_text().splitlines()}
    declared = {path.with_suffix(".py") for path in ROOT.glob("quadtree_lss/**/*.pxd")}
    assert kernels >= {path.relative_to(ROOT) for path in declared if path.exists()}
    for path in build.kernels():
        module = importlib.import_module(module_of(path))
        assert module.__file__ is not None and module.__file__.endswith(EXTENSION_SUFFIXES[0])


def test_the_build_is_named_by_its_sources_and_compilers():
    name = build.name()
    assert build.digest(build.source_hashes(ROOT / "quadtree_lss")).startswith(name[:8])
    assert "Cython" in name
    assert versions()["build"] == name


def test_a_binary_of_other_sources_is_refused_in_one_line(copy):
    assert run(IMPORT, copy).returncode == 0
    core = copy / "quadtree_lss" / "onboard" / "core"
    (core / "geometry" / "later.pxd").touch()
    for code in (
        IMPORT,
        "import quadtree_lss.onboard.nodes.entry as entry; raise SystemExit(entry.mapping_node())",
        "from quadtree_lss.cli import main; raise SystemExit(main(['replay', 'no_bag']))",
    ):
        done = run(code, copy)
        assert done.returncode == 1
        assert "compiled from other sources" in done.stderr.splitlines()[-1]
        assert code == IMPORT or len(done.stderr.splitlines()) == 1


@pytest.mark.slow
def test_without_binaries_nothing_is_imported(copy):
    for binary in copy.rglob("*.so"):
        binary.unlink()
    done = run(IMPORT, copy)
    assert done.returncode == 1
    assert "not compiled for Python" in done.stderr.splitlines()[-1]


def test_no_kernel_has_a_negative_index():
    """Kernels are compiled without wraparound: what such an index means is left to the container,
    and NumPy 2.5 refuses it."""
    found = []
    for path in build.kernels(INSTALLED):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Subscript):
                parts = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
                negative = [isinstance(getattr(part, "op", None), ast.USub) for part in parts]
                if any(negative):
                    found.append(f"{path.name}:{node.lineno} {ast.unparse(node)}")
    assert not found and len(list(build.kernels(INSTALLED))) > 20
