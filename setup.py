# SPDX-License-Identifier: Apache-2.0
"""Package set-up, read by pip and by colcon (ament_python) alike."""

from glob import glob

from Cython.Build import cythonize
from setuptools import Extension, find_packages, setup

NAME = "quadtree_lss"

# The programs that `ros2 run quadtree_lss <name>` finds in lib/quadtree_lss.
ROS_EXECUTABLES = {
    "mapping_node": "quadtree_lss.ros.entry:mapping_node",
    "lss_node": "quadtree_lss.ros.entry:lss_node",
    "replay_bag": "quadtree_lss.cli:main_replay_bag",
    "simulate": "quadtree_lss.cli:main_simulate",
    "evaluate": "quadtree_lss.cli:main_evaluate",
}

# A module of the core with a .pxd beside it is compiled.
KERNELS = [path[:-4] for path in sorted(glob(f"{NAME}/core/*/*.pxd"))]
EXTENSIONS = [
    Extension(
        path.replace("/", "."), [f"{path}.py"], extra_compile_args=["-O3", "-ffp-contract=off"]
    )
    for path in KERNELS
]
DIRECTIVES = {
    "language_level": 3,
    "wraparound": False,
    "cdivision": True,
    "initializedcheck": False,
}

setup(
    name=NAME,
    version="0.1.0",
    description="Terrain map of planar elements and ranked safe landing sites from a flash lidar",
    maintainer="quadtree_lss maintainers",
    maintainer_email="maintainers@example.org",
    license="Apache-2.0",
    python_requires=">=3.10",
    ext_modules=cythonize(
        EXTENSIONS, compiler_directives=DIRECTIVES, build_dir="build/cython", quiet=True
    ),
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "report/*.js", "report/*.css"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", sorted(glob("launch/*.launch.py"))),
        (f"share/{NAME}/rviz", sorted(glob("rviz/*.rviz"))),
        (f"share/{NAME}/foxglove", sorted(glob("foxglove/*.json"))),
        (f"share/{NAME}/config", sorted(glob("config/*.yaml"))),
        # pip puts console scripts into bin/ only; these start them from where ROS looks.
        (f"lib/{NAME}", [f"scripts/{name}" for name in ROS_EXECUTABLES]),
    ],
    zip_safe=False,
    install_requires=[
        "numpy>=1.26",
        "scipy>=1.11",
        "matplotlib>=3.6",
        "PyYAML>=6.0",
        "tqdm>=4.64",
        "rosbags>=0.11",
        "mcap>=1.1",
        "apsw>=3.45",
        "lz4>=4.0",
        "zstandard>=0.20",
    ],
    extras_require={
        # ROS 2 Jazzy from the Python package index, for computers without a ROS installation.
        "wheels": [
            "ros-jazzy-rclpy",
            "ros-jazzy-common-interfaces",
            "ros-jazzy-rmw-fastrtps-cpp",
        ],
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
        "console_scripts": [
            "quadtree-lss = quadtree_lss.cli:main",
            *(f"{name} = {target}" for name, target in ROS_EXECUTABLES.items()),
        ],
    },
)
