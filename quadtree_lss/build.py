# SPDX-License-Identifier: Apache-2.0
"""The compiled kernels: their sources, the name of the build, and a check that both match.

A kernel is a module of `ROOMS` that says ``import cython``. A ``.pxd`` beside it declares what
other kernels call.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import sys
from pathlib import Path
from types import ModuleType

from quadtree_lss.onboard.errors import QuadtreeLssError

PACKAGE = Path(__file__).parent
ROOMS = ("onboard/core/*", "lab/simulation", "lab/evaluation")
FIX = "build it: make setup, pip install . or colcon build"


class BuildError(QuadtreeLssError, ImportError):
    """The kernels are not compiled, or were compiled from other sources."""


def kernels(package: Path = PACKAGE) -> list[Path]:
    return [path for path in _files(package, "py") if b"\nimport cython\n" in path.read_bytes()]


def source_hashes(package: Path = PACKAGE) -> dict[str, str]:
    """Hash every source of the binaries, by its path in the package."""
    files = [*_files(package, "pxd"), *kernels(package)]
    return {
        path.relative_to(package).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
    }


def digest(hashes: dict[str, str]) -> str:
    return hashlib.sha256(repr(sorted(hashes.items())).encode()).hexdigest()


def name() -> str:
    """Name the build: hash of its sources, Cython and C compiler."""
    built = _built()
    if built is None:
        return "not compiled"
    checked = ", checked" if built.CHECKED else ""
    return f"{built.SOURCES[:8]}, Cython {built.CYTHON}, {built.COMPILER}{checked}"


@functools.cache
def check() -> None:
    """Check the build; packages with kernels call this before they are imported. Raises
    `BuildError`: not compiled for this Python, or compiled from other sources."""
    built = _built()
    if built is None:
        version = f"Python {sys.version_info[0]}.{sys.version_info[1]}"
        checkout = (PACKAGE.parent / "setup.py").exists()
        hint = " (PYTHONSAFEPATH=1 selects the installed package instead)" if checkout else ""
        msg = f"the core in {PACKAGE} is not compiled for {version}; {FIX}{hint}"
        raise BuildError(msg)
    if built.SOURCES != digest(source_hashes()):
        msg = f"the core in {PACKAGE} was compiled from other sources; {FIX}"
        raise BuildError(msg)


def _files(package: Path, suffix: str) -> list[Path]:
    return sorted(path for room in ROOMS for path in package.glob(f"{room}/*.{suffix}"))


def _built() -> ModuleType | None:
    try:
        return importlib.import_module("quadtree_lss.built")
    except ModuleNotFoundError:
        return None
