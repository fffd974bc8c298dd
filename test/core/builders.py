# SPDX-License-Identifier: Apache-2.0
"""Configurations, mappers and maps of small scenes, and what is asked of them, for the tests of the
core. All lengths in m, all frames the map's unless a name says other."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from unittest import mock

import numpy as np
from core.kernels import minus
from core.scenes import (  # noqa: F401
    ABOVE,
    EXACT,
    Surface,
    flat,
    make_pose,
    pose_covariance,
    scan,
    scattered,
    slope,
)

from quadtree_lss.onboard.config.settings import Config, config_from_values
from quadtree_lss.onboard.config.vehicle import Lengths, VehicleConfig
from quadtree_lss.onboard.core.geometry import rotations
from quadtree_lss.onboard.core.mapping import measure
from quadtree_lss.onboard.core.mapping.mapper import Mapper, ScanReport
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.tree.cell_map import CellMap, peak
from quadtree_lss.onboard.core.tree.leaves import LeafTable

Array = np.ndarray

#: All that ``mapping.paper`` may be.
METHODS = ("none", "fit", "covariance", "division", "all")

#: Landing by the probability that the lander fails.
BY_RISK = {"assessment": "probability"}
#: Lengths that tests set for themselves.
OWN = ("hazard_growth", "min_separation", "outlier_gate")


def disturbed(pose: Pose, rng: np.random.Generator) -> Pose:
    """The true pose, drawn around an estimate: an error about fixed map axes."""
    error = rng.multivariate_normal(np.zeros(6), pose.covariance)
    turned = rotations.exp(error[3:]) @ pose.rotation_map_lidar
    return Pose(pose.stamp_ns, pose.position + error[:3], turned, pose.covariance)


def look(
    mapper: Mapper,
    surface: Surface,
    x: Array,
    y: Array,
    rng: np.random.Generator | None = None,
    noise: float = 0.0,
    pose: Pose | None = None,
    high: float = 0.0,
) -> ScanReport:
    """Map one scan of the ground at x, y (N,); its pose is told ``high`` metres too high."""
    told = make_pose(ABOVE) if pose is None else pose
    true = dataclasses.replace(told, position=told.position - (0.0, 0.0, high))
    return mapper.update(scan(surface, x, y, true, noise, rng), told)


@dataclasses.dataclass(frozen=True)
class Own(VehicleConfig):
    """A vehicle of which a test sets some of the lengths that follow."""

    own: tuple[tuple[str, float], ...] = ()

    @property
    def lengths(self) -> Lengths:
        return dataclasses.replace(super().lengths, **dict(self.own))


def with_lengths(config: Config, **own: float) -> Config:
    """The same, its vehicle with these lengths."""
    fields = (item.name for item in dataclasses.fields(VehicleConfig))
    vehicle = Own(*(getattr(config.vehicle, name) for name in fields), tuple(own.items()))
    return dataclasses.replace(config, vehicle=vehicle)


def configured(
    levels: tuple[int, int] = (2, 6), noise: float | None = None, **sections: dict[str, object]
) -> Config:
    """A configuration on a small domain of these levels, of range noise if given; ``sections`` are
    laid over it, lengths of a vehicle too.

    Landing is judged by the touchdown check and ranked by the score: hard limits, which can be
    worked out by hand.
    """
    base: dict[str, object] = {
        "domain.xmin": 0.0,
        "domain.ymin": 0.0,
        "domain.size": 16.0,
        "domain.min_level": levels[0],
        "domain.max_level": levels[1],
        **({} if noise is None else {"lidar.range_noise": noise}),
        "lss.assessment": "touchdown",
    }
    values = {f"{s}.{key}": value for s, of in sections.items() for key, value in of.items()}
    own = {key: values.pop(f"vehicle.{key}") for key in OWN if f"vehicle.{key}" in values}
    config = config_from_values({**base, **values})
    return with_lengths(config, **{"outlier_gate": 0.0, **own})


@contextlib.contextmanager
def by(**values: float) -> Iterator[None]:
    """Other constants of the kernels' rules, and lengths of any vehicle, while a mapper is made."""
    follow = {name.lower(): value for name, value in values.items()}
    follow = {name: follow.pop(name) for name in list(follow) if hasattr(Lengths, name)}
    others = {name: value for name, value in values.items() if name.lower() not in follow}
    lengths = mock.patch.object(VehicleConfig, "lengths", Lengths(**follow))
    with mock.patch.dict(vars(measure), others), lengths:
        yield


def mapped(
    config: Config,
    surface: Surface,
    *,
    density: float = 60.0,
    scans: int = 3,
    noise: float | None = None,
    seed: int = 1,
    where: tuple[float, float, float] | None = None,
) -> Mapper:
    """A mapper that saw the whole domain (or the square ``where`` = xmin, ymin, size).

    Args:
        density: Points per square metre and scan.
        noise: True range noise, the configured one if None.
    """
    rng = np.random.default_rng(seed)
    d = config.domain
    xmin, ymin, size = (d.xmin, d.ymin, d.size) if where is None else where
    sigma = config.lidar.range_noise if noise is None else noise
    mapper = Mapper(config)
    for k in range(scans):
        pose = make_pose((xmin + 0.5 * size, ymin + 0.5 * size, 500.0), stamp_ns=1 + k)
        x, y = scattered(rng, xmin, ymin, size, int(density * size**2))
        mapper.update(scan(surface, x, y, pose, sigma, rng), pose)
    return mapper


def divide(
    leaves: LeafTable, row: int, square: float = 0.0, tilt: float = 0.0, spread: float = 0.0
) -> bool:
    """Divide a leaf; its children inherit, as of `LeafTable.divide`."""
    leaves.reserve(3)
    return bool(leaves.divide(row, square, tilt, spread, 0.0))


def leaf_at(mapper: Mapper, x: float, y: float) -> np.record:
    """The leaf over a place, as it is kept."""
    leaves = mapper.leaves.rows[: mapper.leaves.count]
    half = 0.5 * mapper.domain.cell_size(leaves.level)
    under = (np.abs(leaves.x - x) <= half) & (np.abs(leaves.y - y) <= half)
    return leaves[np.flatnonzero(under)[0]]


def elevation(cells: CellMap, x: Array, y: Array) -> Array:
    """Height of the leaf planes at places inside the domain."""
    side = cells.domain.finest_size
    column = np.floor((x - cells.domain.xmin) / side).astype(int)
    row = np.floor((y - cells.domain.ymin) / side).astype(int)
    leaf = cells.leaf_raster()[row, column]
    normal = cells.normal[leaf]
    run = normal[:, 0] * (x - cells.x[leaf]) + normal[:, 1] * (y - cells.y[leaf])
    return cells.z[leaf] - run / normal[:, 2]


def feature_height(state: Array, x: Array, y: Array) -> Array:
    """Eq. 57: height of features (..., 5) at x, y (...) about the cell's centre, A left out."""
    square = (x - state[..., 2]) ** 2 + (y - state[..., 3]) ** 2
    return peak(state) * np.exp(-0.5 * square / state[..., 4] ** 2)


def point_covariances(points_map: Array, pose: Pose, range_noise: float) -> Array:
    """Eq. 17: covariance (N, 3, 3) in m^2 of points (N, 3) in map axes.

    With the pose error (dm, dw) about fixed axes, dr = dm + dw x (r - m), and the range error
    moves the point along its ray u: Sigma_r = J Sigma_pose J^T + sigma^2 u u^T with
    J = [I, -[r - m]_x].
    """
    arm = points_map - pose.position
    moved = np.broadcast_to(np.eye(3), (len(arm), 3, 3))
    jacobian = np.concatenate([moved, -rotations.skew(arm)], axis=-1)
    ray = arm / np.linalg.norm(arm, axis=-1, keepdims=True)
    along = range_noise**2 * ray[:, :, None] * ray[:, None, :]
    out: Array = jacobian @ pose.covariance @ jacobian.transpose(0, 2, 1) + along
    return out


def unit_vectors(rng: np.random.Generator, count: int) -> Array:
    """Directions (count, 3), uniform on the sphere."""
    v = rng.standard_normal((count, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def upward_normals(rng: np.random.Generator, count: int, steepest: float = 0.6) -> Array:
    """Normals (count, 3) that lean by up to ``steepest`` rad."""
    angle, heading = steepest * rng.random(count), 2.0 * np.pi * rng.random(count)
    x, y = np.sin(angle) * (np.cos(heading), np.sin(heading))
    return np.stack([x, y, np.cos(angle)], axis=1)


def random_covariances(rng: np.random.Generator, count: int, size: int, scale: float) -> Array:
    """Positive definite (count, size, size) of standard deviations about ``scale``."""
    root = scale * (rng.standard_normal((count, size, size)) + 1.5 * np.eye(size))
    return root @ root.transpose(0, 2, 1)


def assert_sound(cells: CellMap) -> None:
    """Where there is a plane: nothing but numbers, normals up, no negative covariance."""
    known = cells.estimated
    assert (cells.measured <= known).all()
    assert (cells.normal[known, 2] > 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(cells.normal[known], axis=1), 1.0, atol=1e-9)
    total = np.einsum("mii->mi", cells.covariance[known])
    assert (total > 0.0).all()
    # Round-off leaves each part with errors of the whole's size. Of walls that is all there is.
    ground = cells.normal[known, 2] > 0.1
    scale = np.sqrt(total[ground, :, None] * total[ground, None, :])
    for part in (cells.covariance_range[known], cells.covariance_pose[known]):
        assert np.isfinite(part).all()
        assert np.linalg.eigvalsh(part[ground] / scale).min(initial=0.0) > -0.05
    for value in (cells.roughness, cells.exception_fraction):
        assert (value[cells.measured] >= 0.0).all()
        assert np.isfinite(value[cells.measured]).all()
    assert (cells.exception_fraction[cells.measured] <= 1.0).all()
    assert np.isfinite(cells.feature[np.isfinite(cells.feature[:, 0])]).all()


def assert_same(one: CellMap, other: CellMap, tolerance: float = 0.0, but: str = "none") -> None:
    """All that two maps hold, to the bit or nearly, but for names that begin so."""
    for name in (item.name for item in dataclasses.fields(CellMap)):
        a, b = np.asarray(getattr(one, name)), np.asarray(getattr(other, name))
        if tolerance and a.dtype == np.float64:
            np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance, err_msg=name)
        elif not name.startswith(but):
            np.testing.assert_array_equal(a, b, err_msg=name)


def nees(errors: Array, covariances: Array) -> Array:
    """(M,) e^T C^-1 e of errors (M, K) and their covariances (M, K, K)."""
    return np.einsum("mi,mi->m", errors, np.linalg.solve(covariances, errors[:, :, None])[:, :, 0])


def differentiated(function: Callable[[Array], Array], size: int, step: float = 1e-6) -> Array:
    """Central differences of a function of ``size`` numbers at zero, the last axis."""
    columns = [(function(step * e) - function(-step * e)) / (2.0 * step) for e in np.eye(size)]
    return np.stack(columns, axis=-1)


def plane_errors(cells: CellMap, normal: Array, surface: Surface) -> Array:
    """(M, 3) error of each cell's plane against planar ground, about (x, y, z) of the cell."""
    high = normal[2] * (cells.z - surface(cells.x, cells.y))
    return np.column_stack([[minus(n, normal) for n in cells.normal], high])


def strip(columns: int) -> CellMap:
    """Flat ground of one finest level, 0.25 m, with ``columns`` of it unobserved; of so few returns
    that this may be chance."""
    config = configured(domain={"min_level": 6, "max_level": 6}, lidar={"range_noise": 0.01})
    cells = mapped(config, flat(), density=400.0, scans=1).snapshot()
    assert cells.measured.all()
    missing = (cells.ix >= 30) & (cells.ix < 30 + columns)
    observed = np.ones((64, 64), dtype=bool)
    observed[:, 30 : 30 + columns] = False
    nothing = np.where(missing, np.nan, 0.0)
    return dataclasses.replace(
        cells,
        count=np.full_like(cells.count, 5),
        measured=~missing,
        observed=observed,
        known=observed,
        z=cells.z + nothing,
        normal=cells.normal + nothing[:, None],
    )
