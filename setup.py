# SPDX-License-Identifier: Apache-2.0
"""Package set-up, read by pip and by colcon (ament_python) alike."""

import json
import multiprocessing
import os
import re
import shutil
import sys
from glob import glob
from pathlib import Path

from setuptools import Extension, find_packages, setup

# Modules of the checkout, wherever it is built; colcon may build in a folder of links to it.
sys.path.insert(0, str(Path(__file__).resolve().parent))
import quadtree_lss
import toolchain
from quadtree_lss import build

NAME = "quadtree_lss"

# The programs that `ros2 run quadtree_lss <name>` finds in lib/quadtree_lss.
ROS_EXECUTABLES = {
    "mapping_node": "quadtree_lss.onboard.nodes.entry:mapping_node",
    "lss_node": "quadtree_lss.onboard.nodes.entry:lss_node",
    "replay_bag": "quadtree_lss.cli:main_replay_bag",
    "simulate": "quadtree_lss.cli:main_simulate",
    "evaluate": "quadtree_lss.cli:main_evaluate",
    "quadtree-lss": "quadtree_lss.cli:main",
}

BY_PIP = "bdist_wheel" in sys.argv

# With QUADTREE_LSS_CHECKED=1 every index is checked, even where a kernel waives that.
CHECKED = os.environ.get("QUADTREE_LSS_CHECKED", "0") not in ("", "0")
DIRECTIVES = {
    "language_level": 3,
    "wraparound": False,
    "cdivision": True,
    "boundscheck": True,
    "initializedcheck": CHECKED,
}
COMPILE = ["-O3", "-ffp-contract=off", "-fno-math-errno", "-g0"]
SHARED = f"{NAME}.shared"
# C is written here, and the state it was made of.
GENERATED = Path("build", "cython")
STATE = GENERATED / "state.json"


def is_building() -> bool:
    """pip and colcon ask this file for names and options, several times, before they build."""
    given = set(sys.argv[1:])
    builds = {"build", "build_ext", "bdist_wheel", "install", "develop", "editable_wheel"}
    return bool(given & builds) and not given & {"--help", "--help-commands", "--uninstall"}


def extensions():
    """The kernels, as C if this run is to build, and the module that names the build."""
    if not is_building():
        return [Extension(module_name(path), [str(path)]) for path in build.kernels(Path(NAME))]
    if lack := toolchain.lack_for_building():
        sys.exit(f"{NAME}: {lack}")
    import Cython
    from Cython.Build import cythonize
    from Cython.Compiler.Errors import CompileError

    forget_what_is_gone()
    hashes = build.source_hashes(Path(NAME))
    flags = [Cython.__version__, CHECKED, DIRECTIVES, COMPILE]
    before = json.loads(STATE.read_text()) if STATE.exists() else {"flags": [], "hashes": {}}
    for path, value in hashes.items():
        if before["hashes"].get(path, value) != value:
            os.utime(f"{NAME}/{path}")  # changed, perhaps to a file with an older time
    root = checked_copy() if CHECKED else Path()
    kernels = [
        Extension(module_name(path), [str(root / path)], extra_compile_args=COMPILE)
        for path in build.kernels(Path(NAME))
    ]
    options = {}
    if tuple(map(int, Cython.__version__.split(".")[:2])) >= (3, 1) and kernels:
        # What all kernels have in common, compiled once: a third less time.
        kernels.insert(
            0, Extension(SHARED, [f"{NAME}/shared.c"], extra_compile_args=["-O1", "-g0"])
        )
        options["shared_utility_qualified_name"] = SHARED
    if multiprocessing.get_start_method() == "fork":  # the others would run this file once more
        options["nthreads"] = 2
    # Not a word on stdout, which colcon reads.
    try:
        kernels = cythonize(
            kernels,
            compiler_directives=DIRECTIVES,
            build_dir=str(GENERATED),
            force=before["flags"] != flags,
            quiet=True,
            **options,
        )
    except CompileError as error:  # which has said what is wrong
        sys.exit(f"{NAME}: Cython cannot compile {error}")
    state = json.dumps({"flags": flags, "hashes": hashes})
    if not STATE.exists() or STATE.read_text() != state:
        GENERATED.mkdir(parents=True, exist_ok=True)
        STATE.write_text(state)
    macros = [
        ("SOURCES", f'"{build.digest(hashes)}"'),
        ("CYTHON", f'"{Cython.__version__}"'),
        ("CHECKED", str(int(CHECKED))),
    ]
    source, depends = [f"{NAME}/built.c"], [str(STATE)]
    return [*kernels, Extension(f"{NAME}.built", source, define_macros=macros, depends=depends)]


def module_name(path):
    return ".".join(path.with_suffix("").parts)


def forget_what_is_gone():
    """Files of earlier builds without a source here, since whatever lies there is installed."""
    base = sys.argv[sys.argv.index("--build-base") + 1] if "--build-base" in sys.argv else "build"
    for root in (Path(), *Path(base).glob("lib*")):
        for path in (root / NAME).rglob("*"):
            source = path.relative_to(root)
            if path.suffix == ".so":
                source = source.with_name(source.name.split(".")[0] + ".pxd")
            own = path.name.startswith(("built.", "shared."))
            if path.is_file() and not source.exists() and not own:
                path.unlink()


def checked_copy():
    """A copy of the kernels that waives no check of an index."""
    copy = GENERATED / "checked"
    shutil.rmtree(copy, ignore_errors=True)
    for source in (
        Path(NAME, "__init__.py"),
        *Path(NAME, "onboard", "core").rglob("*"),
        *Path(NAME, "lab", "simulation").glob("*"),
    ):
        if source.suffix in (".py", ".pxd"):
            text = source.read_text(encoding="utf-8")
            (copy / source).parent.mkdir(parents=True, exist_ok=True)
            (copy / source).write_text(
                re.sub(r"boundscheck(\(|=)False", r"boundscheck\1True", text)
            )
    return copy


setup(
    name=NAME,
    version=quadtree_lss.__version__,
    description="Terrain map of planar elements and ranked safe landing sites from a flash lidar",
    maintainer="quadtree_lss maintainers",
    maintainer_email="maintainers@example.org",
    license="Apache-2.0",
    python_requires=">=3.10",
    ext_modules=extensions(),
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={
        NAME: [
            "py.typed",
            "onboard/core/*/*.pxd",
            "onboard/config/*.yaml",
            "lab/simulation/*.pxd",
            "desk/report/*.js",
            "desk/report/*.css",
            "desk/report/*.html",
            "desk/report/vendor/*",
        ]
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", sorted(glob("launch/*.launch.py"))),
        (f"share/{NAME}/rviz", sorted(glob("rviz/*.rviz"))),
        (f"share/{NAME}/security", ["security/policy.xml"]),
        (f"share/{NAME}/foxglove", sorted(glob("foxglove/*.json"))),
        (f"share/{NAME}/examples", sorted(glob("examples/*.py"))),
        (f"share/{NAME}/config", sorted(glob("config/*.yaml"))),
        # pip puts console scripts into bin/ only; these start them from where ROS looks, which
        # colcon itself sees to.
        (f"lib/{NAME}", [f"scripts/{name}" for name in ROS_EXECUTABLES if BY_PIP]),
    ],
    zip_safe=False,
    install_requires=[
        "numpy>=1.26",
        "scipy>=1.11",
        "matplotlib>=3.6",
        "PyYAML>=6.0",
        "tqdm>=4.64",
        "argcomplete>=2.0",
        "rosbags>=0.11",
        "apsw>=3.45",
        "lz4>=4.0",
        "zstandard>=0.20",
    ],
    extras_require={
        # Many flights on the cores of this or of other computers.
        "campaign": ["distributed>=2024.2", "bokeh>=3.1"],
        # ROS 2 Jazzy from the Python package index, for computers without a ROS installation.
        "wheels": [
            "ros-jazzy-rclpy",
            "ros-jazzy-common-interfaces",
            "ros-jazzy-rmw-fastrtps-cpp",
        ],
        # Other programs' files: GeoTIFF, meshes, point clouds.
        "exchange": [
            "rasterio>=1.3",
            "trimesh>=4.0",
            "laspy>=2.4",
            "lazrs>=0.5",
            "pypcd4>=1.1",
        ],
        # The least propellant that a flight could need, by convex programs.
        "guidance": ["cvxpy>=1.6", "clarabel>=0.9"],
        "test": [
            "pytest>=8.0",
            "pytest-xdist>=3.5",
            "hypothesis>=6.90",
            "psutil>=5.9",
            "ruff>=0.9",
            "mypy>=1.10",
            "types-PyYAML",
            "scipy-stubs; python_version >= '3.11'",
        ],
    },
    entry_points={
        "console_scripts": [f"{name} = {target}" for name, target in ROS_EXECUTABLES.items()],
    },
)
