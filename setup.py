# SPDX-License-Identifier: Apache-2.0
"""Compiles the kernels; whatever else pip and colcon (ament_python) read is in pyproject.toml."""

import json
import multiprocessing
import os
import re
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
# QUADTREE_LSS_CHECKED=1 checks every index, also where a kernel turns this off.
CHECKED = os.environ.get("QUADTREE_LSS_CHECKED", "0") not in ("", "0")
DIRECTIVES = {"language_level": 3, "wraparound": False, "cdivision": True, "boundscheck": True}
DIRECTIVES |= {"initializedcheck": CHECKED, "show_performance_hints": False}
COMPILE = ["-O3", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-g0"]
GENERATED = Path("build", "cython")  # generated C, and the hashes and flags that it was made with
STATE = GENERATED / "state.json"


def extensions():
    """The compiled modules, if this run builds them."""
    builds = {"build", "build_ext", "bdist_wheel", "install", "develop", "editable_wheel"}
    asked = set(sys.argv[1:])
    if not asked & builds or asked & {"--help", "--help-commands", "--uninstall"}:
        return []
    if lack := toolchain.lack_for_building():
        sys.exit(f"{NAME}: {lack}")
    import Cython
    from Cython.Build import cythonize
    from Cython.Compiler import Errors

    hashes = build.source_hashes(PACKAGE)
    remove_outdated_c(hashes, [Cython.__version__, CHECKED, DIRECTIVES, COMPILE])
    remove_outdated_files()
    root = checked_copy() if CHECKED else Path()
    kernels = [kernel(path, root) for path in build.kernels(PACKAGE)]
    Errors.LEVEL = 2  # colcon reports a warning as a fault; Cython 3.0 has many without meaning
    options = {"nthreads": 2} if multiprocessing.get_start_method() == "fork" else {}
    if tuple(map(int, Cython.__version__.split(".")[:2])) >= (3, 1):
        # Code that all kernels share is compiled once, which takes a third less time.
        options["shared_utility_qualified_name"] = f"{NAME}.shared"
        shared = [f"{NAME}/shared.c"]
        kernels.insert(0, Extension(f"{NAME}.shared", shared, extra_compile_args=["-O1", "-g0"]))
    options |= {"compiler_directives": DIRECTIVES, "build_dir": str(GENERATED)}
    kernels = cythonize(kernels, quiet=True, **options)  # colcon reads stdout: nothing on it
    macros = [("SOURCES", f'"{build.digest(hashes)}"'), ("CYTHON", f'"{Cython.__version__}"')]
    how = {"define_macros": [*macros, ("CHECKED", str(int(CHECKED)))], "depends": [str(STATE)]}
    return [*kernels, Extension(f"{NAME}.built", [f"{NAME}/built.c"], **how)]


def kernel(path, root):
    name = ".".join(path.with_suffix("").parts)
    # -w: gcc warns of generated C without reason, and colcon reports that as a fault. Without libm
    # by name, exp is that of the oldest C library: scans take a hundredth longer.
    arguments = [*COMPILE, "-w"]
    return Extension(name, [str(root / path)], extra_compile_args=arguments, libraries=["m"])


def remove_outdated_c(hashes, flags):
    """Remove generated C whose source or flags changed, so that it and its binary are remade."""
    state = json.dumps({"flags": flags, "hashes": hashes})
    before = STATE.read_text() if STATE.exists() else '{"flags": [], "hashes": {}}'
    if state == before:
        return
    old = json.loads(before)
    changed = {path for path, value in hashes.items() if old["hashes"].get(path) != value}
    if old["flags"] != flags or any(path.endswith(".pxd") for path in changed):
        shutil.rmtree(GENERATED, ignore_errors=True)
    for path in changed:
        GENERATED.joinpath(NAME, path).with_suffix(".c").unlink(missing_ok=True)
    GENERATED.mkdir(parents=True, exist_ok=True)
    STATE.write_text(state)


def remove_outdated_files():
    """Remove from the build folder all but binaries of present kernels, and from the checkout
    binaries of kernels that are gone: they would be installed, or imported first."""
    names = {f"{NAME}/shared", f"{NAME}/built", *(str(p)[:-3] for p in build.kernels(PACKAGE))}
    given = sys.argv[1:] if "--build-base" in sys.argv else ["--build-base", "build"]
    for folder in Path(given[given.index("--build-base") + 1]).glob("lib*"):
        for path in folder.rglob("*"):
            if path.is_file() and not is_binary(path.relative_to(folder), names):
                path.unlink()
    for path in PACKAGE.rglob("*.so"):
        if not is_binary(path, names):
            path.unlink()


def is_binary(path, names):
    return path.suffix == ".so" and str(path).partition(".")[0] in names


def checked_copy():
    """Copy the package, with every index checked."""
    copy = GENERATED / "checked"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(PACKAGE, copy / NAME, ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    for source in copy.rglob("*.py"):
        text = source.read_text(encoding="utf-8")
        source.write_text(re.sub(r"boundscheck(\(|=)False", r"boundscheck\1True", text))
    return copy


if not Path("pyproject.toml").exists():  # colcon --symlink-install builds in a folder of links
    os.symlink(Path(__file__).resolve().with_name("pyproject.toml"), "pyproject.toml")
# What colcon cannot read, or setuptools takes in another form from version to version.
setup(python_requires=">=3.10", license="Apache-2.0", ext_modules=extensions())
