# SPDX-License-Identifier: Apache-2.0
"""What the package lacks to be set up here, in one line: ``python3 toolchain.py``.

Of the standard library alone, also an old one's, since it is run before anything is installed.
"""

from __future__ import annotations

import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig

OLDEST = (3, 10)


def lack_for_setup() -> str | None:
    """What ``make setup`` lacks: a recent Python, venv, a C compiler, Python's headers."""
    if sys.version_info < OLDEST:
        here = f"{sys.executable} is {sys.version_info[0]}.{sys.version_info[1]}"
        return f"Python 3.10 or newer is needed, {here}: make PYTHON=python3.12 takes another"
    if not all(importlib.util.find_spec(module) for module in ("venv", "ensurepip")):
        return "Python's venv is missing: apt install python3-venv"
    return lack_for_compiling()


def lack_for_building() -> str | None:
    """What ``pip install .`` and colcon lack: Cython, a C compiler, Python's headers."""
    if importlib.util.find_spec("Cython") is None:
        return "Cython, which compiles the core, is missing: apt install cython3"
    return lack_for_compiling()


def lack_for_compiling() -> str | None:
    """A C compiler, Python's headers, the C library's: the first that is missing."""
    compiler = shlex.split(os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc")
    if shutil.which(compiler[0]) is None:
        return f"a C compiler ({compiler[0]}) for the core is missing: apt install build-essential"
    folders = include_folders()
    if not any(os.path.isfile(os.path.join(folder, "Python.h")) for folder in folders):
        looked = " or ".join(folders)
        return f"Python's C headers are missing (Python.h in {looked}): apt install python3-dev"
    trial = subprocess.run(
        [*compiler, "-fsyntax-only", *(f"-I{folder}" for folder in folders), "-x", "c", "-"],
        input="#include <Python.h>\n",
        capture_output=True,
        text=True,
        check=False,
    )
    if trial.returncode:
        said = [line for line in trial.stderr.splitlines() if "error" in line] or compiler
        return f"the C compiler fails ({said[0]}): apt install build-essential python3-dev"
    return None


def include_folders() -> list[str]:
    """Where Python.h may be: distributions and Pythons that were moved differ in who knows it."""
    folders = (
        sysconfig.get_path("include"),
        sysconfig.get_path("platinclude"),
        sysconfig.get_config_var("INCLUDEPY"),
    )
    return list(dict.fromkeys(folder for folder in folders if folder))


if __name__ == "__main__":
    lack = lack_for_setup()
    sys.exit(f"quadtree_lss: {lack}" if lack else 0)
