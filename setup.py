# SPDX-License-Identifier: Apache-2.0
"""Compiles the kernels; whatever else pip and colcon (ament_python) read is in pyproject.toml."""

import json
import multiprocessing
import os
import shutil
import sys
from pathlib import Path

from setuptools import Extension, setup

# Modules of the checkout, wherever it is built.
sys.path.insert(0, str(Path(__file__).resolve().parent))
import toolchain
from quadtree_lss import build

NAME = "quadtree_lss"
PACKAGE = Path(NAME)
# With QUADTREE_LSS_CHECKED=1 every index is checked, even where a kernel waives that.
CHECKED = os.environ.get("QUADTREE_LSS_CHECKED", "0") not in ("", "0")
DIRECTIVES = {"language_level": 3, "wraparound": False, "cdivision": True, "boundscheck": True}
DIRECTIVES |= {"initializedcheck": CHECKED, "show_performance_hints": False}
COMPILE = ["-O3", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-g0"]
GENERATED = Path("build", "cython")  # C is written here, and of what it was made
STATE = GENERATED / "state.json"


def extensions():
    """The kernels, as C if this run is to build, and the module that names the build."""
    builds = {"build", "build_ext", "bdist_wheel", "install", "develop", "editable_wheel"}
    asked = set(sys.argv[1:])
    if not asked & builds or asked & {"--help", "--help-commands", "--uninstall"}:
        return [kernel(path) for path in build.kernels(PACKAGE)]
    if lack := toolchain.lack_for_building():
        sys.exit(f"{NAME}: {lack}")
    import Cython
    from Cython.Build import cythonize
    from Cython.Compiler import Errors

    hashes = build.source_hashes(PACKAGE)
    state = {"flags": [Cython.__version__, CHECKED, DIRECTIVES, COMPILE], "hashes": hashes}
    forget_what_changed(state)
    root = checked_copy() if CHECKED else Path()
    kernels = [kernel(path, root) for path in build.kernels(PACKAGE)]
    Errors.LEVEL = 2  # colcon takes a warning for a fault; 3.0 has many that mean nothing
    options = {"nthreads": 2} if multiprocessing.get_start_method() == "fork" else {}
    if tuple(map(int, Cython.__version__.split(".")[:2])) >= (3, 1):
        # What all kernels have in common, compiled once: a third less time.
        options["shared_utility_qualified_name"] = f"{NAME}.shared"
        shared = [f"{NAME}/shared.c"]
        kernels.insert(0, Extension(f"{NAME}.shared", shared, extra_compile_args=["-O1", "-g0"]))
    options |= {"compiler_directives": DIRECTIVES, "build_dir": str(GENERATED)}
    kernels = cythonize(kernels, quiet=True, **options)  # not a word on stdout, which colcon reads
    STATE.write_text(json.dumps(state))
    macros = [("SOURCES", f'"{build.digest(hashes)}"'), ("CYTHON", f'"{Cython.__version__}"')]
    how = {"define_macros": [*macros, ("CHECKED", str(int(CHECKED)))], "depends": [str(STATE)]}
    return [*kernels, Extension(f"{NAME}.built", [f"{NAME}/built.c"], **how)]


def kernel(path, root=Path()):
    name = ".".join(path.with_suffix("").parts)
    # Without the library's name exp is that of the oldest C library: a hundredth of a scan slower.
    return Extension(name, [str(root / path)], extra_compile_args=COMPILE, libraries=["m"])


def forget_what_changed(state):
    """C of other sources; what earlier builds left, which would be installed or imported first."""
    before = json.loads(STATE.read_text()) if STATE.exists() else {"flags": [], "hashes": {}}
    changed = {
        path for path, value in state["hashes"].items() if before["hashes"].get(path) != value
    }
    if before["flags"] != state["flags"] or any(path.endswith(".pxd") for path in changed):
        shutil.rmtree(GENERATED, ignore_errors=True)
    for path in changed:
        GENERATED.joinpath(NAME, path).with_suffix(".c").unlink(missing_ok=True)
    GENERATED.mkdir(parents=True, exist_ok=True)
    given = sys.argv[1:] if "--build-base" in sys.argv else ["--build-base", "build"]
    for folder in Path(given[given.index("--build-base") + 1]).glob("lib*"):
        shutil.rmtree(folder)
    names = {f"{NAME}/shared", f"{NAME}/built", *(str(p)[:-3] for p in build.kernels(PACKAGE))}
    for binary in PACKAGE.rglob("*.so"):
        if str(binary).partition(".")[0] not in names:
            binary.unlink()


def checked_copy():
    """A copy of the package whose kernels waive no check of an index."""
    copy = GENERATED / "checked"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(PACKAGE, copy / NAME, ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    for source in copy.rglob("*.py"):
        text = source.read_text(encoding="utf-8")
        source.write_text(text.replace("boundscheck(False)", "boundscheck(True)"))
    return copy


if not Path("pyproject.toml").exists():  # colcon --symlink-install builds in a folder of links
    os.symlink(Path(__file__).resolve().with_name("pyproject.toml"), "pyproject.toml")
# What colcon cannot read, or setuptools takes in another form from version to version.
setup(python_requires=">=3.10", license="Apache-2.0", ext_modules=extensions())
