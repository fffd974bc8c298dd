# SPDX-License-Identifier: Apache-2.0
"""The build of the kernels: what it is made of, its name, whether it is of these sources.

A kernel, a module of `ROOMS` that says ``import cython``, is compiled; its source runs as it is,
too: ``QUADTREE_LSS_INTERPRETED=1`` takes the sources, for a debugger, a hundred times
slower. What other kernels call stands in a ``.pxd`` beside it.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import os
import sys
from collections.abc import Sequence
from importlib.machinery import EXTENSION_SUFFIXES, ModuleSpec
from pathlib import Path
from types import ModuleType

import quadtree_lss
from quadtree_lss.onboard.errors import QuadtreeLssError

PACKAGE = Path(__file__).parent
ROOMS = ("onboard/core/*", "lab/simulation", "lab/evaluation")
REMEDY = "build it: make setup, pip install . or colcon build"


class BuildError(QuadtreeLssError, ImportError):
    """The core cannot be imported as it was built."""


def kernels(package: Path = PACKAGE) -> list[Path]:
    """The sources that are compiled, sorted."""
    return [path for path in _files(package, "py") if is_kernel(path)]


def is_kernel(path: Path) -> bool:
    """Whether a source is to be compiled."""
    return b"\nimport cython\n" in path.read_bytes()


def source_hashes(package: Path = PACKAGE) -> dict[str, str]:
    """Hash of every file that the binaries are made of, by its path in the package."""
    files = [*_files(package, "pxd"), *kernels(package)]
    return {
        path.relative_to(package).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
    }


def digest(hashes: dict[str, str]) -> str:
    """One hash of all."""
    return hashlib.sha256(repr(sorted(hashes.items())).encode()).hexdigest()


def name() -> str:
    """Which build this is: its sources' hash and what compiled them."""
    if interpreted():
        return f"{digest(source_hashes())[:8]}, interpreted"
    built = _built()
    if built is None:
        return "not compiled"
    checked = ", checked" if built.CHECKED else ""
    return f"{built.SOURCES[:8]}, Cython {built.CYTHON}, {built.COMPILER}{checked}"


def interpreted() -> bool:
    """Whether the sources are to be run instead of the binaries."""
    return os.environ.get("QUADTREE_LSS_INTERPRETED", "0") not in ("", "0")


@functools.cache
def check() -> None:
    """Lets a room of kernels be imported, which calls this first. Raises `BuildError`: it is not
    compiled for this Python, or of other sources than those beside it."""
    if interpreted():
        if importlib.util.find_spec("cython") is None:
            msg = "QUADTREE_LSS_INTERPRETED needs Cython: apt install cython3"
            raise BuildError(msg)
        sys.meta_path.insert(0, _Sources())
        return
    built = _built()
    version = f"Python {sys.version_info[0]}.{sys.version_info[1]}"
    if built is None:
        checkout = (PACKAGE.parent / "setup.py").exists()
        hint = " (PYTHONSAFEPATH=1 takes what is installed instead)" if checkout else ""
        msg = f"the core in {PACKAGE} is not compiled for {version}; {REMEDY}{hint}"
        raise BuildError(msg)
    if built.SOURCES != digest(source_hashes()):
        msg = f"the core in {PACKAGE} was compiled from other sources than those there; {REMEDY}"
        raise BuildError(msg)
    for path in kernels():
        if not path.with_suffix(EXTENSION_SUFFIXES[0]).exists():
            msg = f"{path} is not compiled for {version}; {REMEDY}"
            raise BuildError(msg)


def _files(package: Path, suffix: str) -> list[Path]:
    return sorted(path for room in ROOMS for path in package.glob(f"{room}/*.{suffix}"))


def _built() -> ModuleType | None:
    try:
        return importlib.import_module("quadtree_lss.built")
    except ModuleNotFoundError:
        return None


class _Sources:
    """Finds a kernel's source where Python would take the binary beside it."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        source = PACKAGE.parent.joinpath(*name.split(".")).with_suffix(".py")
        own = name.startswith(f"{quadtree_lss.__name__}.") and source in _files(PACKAGE, "py")
        if not own or not is_kernel(source):
            return None
        return importlib.util.spec_from_file_location(name, source)
