# SPDX-License-Identifier: Apache-2.0
"""What is missing to compile is said first, in one line that names what to install."""

import runpy
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def toolchain():
    return runpy.run_path(str(ROOT / "toolchain.py"))


def test_nothing_is_missing_here(toolchain):
    assert toolchain["lack_for_setup"]() is None
    assert toolchain["lack_for_building"]() is None


def test_a_missing_compiler_is_named(toolchain, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    assert "apt install build-essential" in toolchain["lack_for_setup"]()


def test_missing_headers_are_named(toolchain, monkeypatch, tmp_path):
    monkeypatch.setattr(sysconfig, "get_path", lambda name: str(tmp_path))
    monkeypatch.setattr(sysconfig, "get_config_var", {"INCLUDEPY": str(tmp_path), "CC": "cc"}.get)
    assert "apt install python3-dev" in toolchain["lack_for_building"]()


@pytest.mark.parametrize(
    ("module", "package"), [("Cython", "cython3"), ("ensurepip", "python3-venv")]
)
def test_missing_modules_are_named(toolchain, monkeypatch, module, package):
    lack = toolchain["lack_for_building" if module == "Cython" else "lack_for_setup"]
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == module else name)
    assert f"apt install {package}" in lack()


def test_a_compiler_that_fails_is_told(toolchain, monkeypatch):
    monkeypatch.setenv("CC", "false")
    assert "the C compiler fails (false)" in toolchain["lack_for_compiling"]()


@pytest.mark.parametrize("command", [["toolchain.py"], ["setup.py", "build"]])
def test_setting_up_ends_with_one_line(command, tmp_path):
    how = {"cwd": ROOT, "env": {"PATH": str(tmp_path)}, "capture_output": True}
    done = subprocess.run([sys.executable, *command], **how)
    assert done.returncode == 1 and done.stdout == b""
    (line,) = done.stderr.splitlines()
    assert line.startswith(b"quadtree_lss: ") and b"build-essential" in line
