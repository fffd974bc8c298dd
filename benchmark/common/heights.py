# SPDX-License-Identifier: Apache-2.0
"""Mean heights of a raw scan on a fixed grid, the simplest terrain map, in a compiled loop: a lower
bound for any method that processes each point.
"""

from __future__ import annotations

import functools
import importlib.util
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.tree.domain import Domain

Heights = Callable[[Array, Pose], Array]
"""From points (…, 3), float64, in lidar axes and the pose to mean heights (n, n) [iy, ix], m."""


def mean_heights(domain: Domain) -> Heights:
    """Make the loop for the finest cells of ``domain``; cells without points are 0."""
    n, size, low = domain.finest_count, domain.finest_size, (domain.xmin, domain.ymin)
    loop = compiled(Path(__file__).with_name("height_loop.py")).mean_heights
    count, mean = np.zeros((n, n)), np.zeros((n, n))

    def by_loop(points: Array, pose: Pose) -> Array:
        turn, place = pose.rotation_map_lidar, pose.position
        loop(points.reshape(-1, 3), turn, place, *low, size, count, mean)
        return mean

    return by_loop


@functools.cache
def compiled(source: Path) -> ModuleType:
    """Compile a Cython source with the flags of the kernels; return its module."""
    from Cython.Build import cythonize
    from setuptools import Distribution, Extension

    with tempfile.TemporaryDirectory() as folder:
        flags = ["-O3", "-ffp-contract=off"]
        extension = Extension(source.stem, [str(source)], extra_compile_args=flags)
        modules = cythonize([extension], build_dir=folder, quiet=True, language_level=3)
        build = Distribution({"ext_modules": modules}).get_command_obj("build_ext")
        build.build_lib = build.build_temp = folder
        build.ensure_finalized()
        build.run()
        spec = importlib.util.spec_from_file_location(
            source.stem, build.get_ext_fullpath(source.stem)
        )
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module
