# SPDX-License-Identifier: Apache-2.0
"""What is missing to compile is said first, in one line that names what to install."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("command", [["toolchain.py"], ["setup.py", "build"]])
def test_setting_up_ends_with_one_line(command, tmp_path):
    how = {"cwd": ROOT, "env": {"PATH": str(tmp_path)}, "capture_output": True}
    done = subprocess.run([sys.executable, *command], **how)
    assert done.returncode == 1 and done.stdout == b""
    (line,) = done.stderr.splitlines()
    assert line.startswith(b"quadtree_lss: ") and b"build-essential" in line
