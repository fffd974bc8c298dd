# SPDX-License-Identifier: Apache-2.0
"""A touchdown by MuJoCo: from the last moment of free flight until the vehicle rests, and a judge.

The engine is off. The true ground is a height field of the terrain's own posts, or of finer ones
between them, about the touchdown.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from quadtree_lss.lab.simulation.terrain import SimulationError, Terrain, spacing
from quadtree_lss.lab.touchdown.legs import Legs
from quadtree_lss.onboard.arrays import Array

LONGEST, LOOK, FILM = 30.0, 5, 30
"""s of a touchdown at most; steps between two looks at it; poses a second that are kept."""
REACH = 2.0
"""Half side of the ground about a touchdown, diameters of the pads' circle; at the edge of the
terrain it is less, but for the circle and `SLID`."""
FINE = 37.0
"""Posts are no farther apart than the diameter over this."""
TIPPED_DEG = 40.0
"""From the vertical at rest: no longer on its feet; ..."""
FALLING_DEG = 75.0
"""... and on its way there, no vehicle comes back."""
SLID = 0.135
"""That it may slide from where it touched, diameters of the pads' circle: the margin of sites."""
AT_REST = 0.02
"""Fastest foot of a vehicle at rest, m/s, for `CALM` looks."""
CALM = 100
OUTCOMES = ("stands", "slid", "body strike", "tipped")


class NoPhysics(SimulationError):
    """The physics engine is not installed."""


@dataclass(frozen=True)
class Arrival:
    """The last moment of free flight, map frame; m, rad, s: the middle of the pads' plane, whose
    height follows from the ground; velocity (3,) of the centre of mass; unit vector ``up`` (3,) of
    the vehicle's axis; heading of its x axis, from the map's; angular velocity ``turn`` (3,)."""

    x: float
    y: float
    velocity: Array
    up: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    heading: float = 0.0
    turn: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def rotation(self) -> Rotation:
        """Takes the body frame to the map."""
        across = np.cross([0.0, 0.0, 1.0], self.up)
        size = float(np.linalg.norm(across))
        lean = across / max(size, 1e-12) * np.arctan2(size, self.up[2])
        return Rotation.from_rotvec(lean) * Rotation.from_euler("z", self.heading)


@dataclass(frozen=True)
class Landed:
    """What became of a touchdown.

    Attributes:
        outcome: The worst of `OUTCOMES`: stands; slid farther than `SLID`, or still slides; body
            strike, the ground reached into it before it tipped; tipped, `TIPPED_DEG` and more.
        tilt_deg: From the vertical at the end.
        slid: From where it touched to where it is, horizontally, m.
        stroke: Of the strut that gave way most, m.
        struck: The ground reached into the body.
        seconds: Until it rested.
        gained: Mechanical energy that it ever gained, over the kinetic energy that it came with and
            its weight times the clearance. There is none to gain: it says how good the engine's
            contacts were.
        film: (T, 8) time, place of the middle of the pads' plane in the map, quaternion w, x, y, z.
    """

    outcome: str
    tilt_deg: float
    slid: float
    stroke: float
    struck: bool
    seconds: float
    gained: float
    film: Array


def touch(legs: Legs, terrain: Terrain, arrival: Arrival) -> Landed:
    """One touchdown; the same for the same arguments. Raises `NoPhysics`: the extra ``physics`` is
    not installed; `SimulationError`: it is too near to the edge of the terrain."""
    mujoco = engine()
    model, data, corner = placed(legs, terrain, arrival)
    posts, diameter = ground(legs, terrain, arrival), legs.gear.diameter
    start, least = data.qpos[:2].copy(), float(data.energy.sum())
    had = float(data.energy[1]) + legs.mass * legs.gravity * legs.gear.max_roughness
    film: list[Array] = []
    struck, calm, stroke, gained = False, 0, 0.0, 0.0
    while data.time < LONGEST and calm < CALM:
        if data.time * FILM >= len(film):
            film.append(np.r_[data.time, data.qpos[:7]])
        mujoco.mj_step(model, data, LOOK)
        energy, axes = float(data.energy.sum()), data.xmat[1].reshape(3, 3)
        least = min(least, energy)
        gained = max(gained, energy - least)
        stroke = max(stroke, float(data.qpos[7:].max()))
        tilt = float(np.degrees(np.arccos(np.clip(axes[2, 2], -1.0, 1.0))))
        place = data.qpos[:3] + corner
        struck = struck or (tilt < TIPPED_DEG and strikes(legs, posts, place, axes))
        fastest = np.linalg.norm(data.qvel[:3]) + 0.5 * diameter * np.linalg.norm(data.qvel[3:6])
        calm = calm + 1 if fastest < AT_REST else 0
        if tilt > FALLING_DEG:
            break
    film.append(np.r_[data.time, data.qpos[:7]])
    slid = float(np.hypot(*(data.qpos[:2] - start)))
    was = True, slid > SLID * diameter or calm < CALM, struck, tilt > TIPPED_DEG
    outcome = OUTCOMES[max(k for k, of in enumerate(was) if of)]
    poses, seconds = np.array(film), float(data.time)
    poses[:, 1:4] += corner
    return Landed(outcome, tilt, slid, stroke, struck, seconds, gained / had, poses)


def strikes(legs: Legs, posts: tuple[Array, Array, Array], place: Array, axes: Array) -> bool:
    """Whether a post is inside of the body: as of `ground`, for a vehicle at ``place`` (3,), map
    frame, whose axes are the columns of ``axes`` (3, 3)."""
    x, y, elevation = posts
    (left, right), (low, high) = (
        np.searchsorted(axis, (at - legs.radius, at + legs.radius))
        for axis, at in ((x, place[0]), (y, place[1]))
    )
    over = elevation[low:high, left:right] - place[2]
    offsets = x[None, left:right] - place[0], y[low:high, None] - place[1], over
    along, across, up = (sum(axes[k, n] * offsets[k] for k in range(3)) for n in range(3))
    inside = np.hypot(along, across) <= legs.body * legs.radius
    return bool((inside & (up > legs.underside) & (up < 2.0 * legs.centre)).any())


def placed(legs: Legs, terrain: Terrain, arrival: Arrival) -> tuple[Any, Any, Array]:
    """The engine's model and state as the vehicle is about to touch, and the origin (3,) of the
    engine's frame in the map, m: the middle of the ground about the touchdown."""
    mujoco = engine()
    x, y, heights = ground(legs, terrain, arrival)
    low, relief = float(heights.min()), max(float(np.ptp(heights)), 1e-6)
    half = 0.5 * (x[-1] - x[0]), 0.5 * (y[-1] - y[0])
    model = mujoco.MjModel.from_xml_string(legs.model(y.size, x.size, half, relief))
    model.hfield_data[:] = ((heights - low) / relief).ravel()
    corner = np.array([0.5 * (x[0] + x[-1]), 0.5 * (y[0] + y[-1]), low])
    data, turn = mujoco.MjData(model), arrival.rotation
    # As low as neither a pad nor the body reaches the ground.
    points = under(legs)
    places = turn.apply(points) + [arrival.x, arrival.y, 0.0]
    reached = terrain.elevation_at(places[:, 0], places[:, 1]) - places[:, 2]
    data.qpos[:3] = np.array([arrival.x, arrival.y, float(np.max(reached)) + 1e-3]) - corner
    data.qpos[3:7] = np.roll(turn.as_quat(), 1)
    spin = np.asarray(arrival.turn, dtype=np.float64)
    arm = turn.apply([0.0, 0.0, legs.centre])
    data.qvel[:3] = arrival.velocity - np.cross(spin, arm)
    data.qvel[3:6] = turn.inv().apply(spin)
    mujoco.mj_forward(model, data)
    while data.ncon and (into := -float(data.contact.dist.min())) > 1e-4:  # of a rim into a rock
        data.qpos[2] += into
        mujoco.mj_forward(model, data)
    return model, data, corner


def ground(legs: Legs, terrain: Terrain, arrival: Arrival) -> tuple[Array, Array, Array]:
    """Posts x (nx,), y (ny,) and elevation (ny, nx) about a touchdown, the terrain's among them."""
    reach, axes = REACH * legs.gear.diameter, []
    for axis, place in ((terrain.x, arrival.x), (terrain.y, arrival.y)):
        post = spacing(axis)
        first, last = np.searchsorted(axis, (place - reach, place + reach))
        first, last = max(int(first) - 1, 0), min(int(last), axis.size - 1)
        least = (0.5 + SLID) * legs.gear.diameter
        if not axis[0] + least <= place <= axis[-1] - least:
            msg = f"touchdown at {arrival.x:.2f}, {arrival.y:.2f} m: too near the terrain's edge"
            raise SimulationError(msg)
        parts = max(int(np.ceil(post * FINE / legs.gear.diameter - 1e-6)), 1)
        axes.append(np.linspace(axis[first], axis[last], (last - first) * parts + 1))
    x, y = axes
    return x, y, terrain.elevation_at(x[None, :], y[:, None])


def under(legs: Legs) -> Array:
    """(K, 3) points of pads and of the body's underside, body frame."""
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(24)], axis=1)
    shares = np.linspace(0.0, 1.0, 5)[:, None, None]
    pads = legs.pads[:, None, None] + shares * legs.gear.pad_radius * ring
    if legs.skids:
        along = np.linspace(0.0, 1.0, 9)[:, None]
        pads = along * legs.pads[[1, 3], None] + (1.0 - along) * legs.pads[[0, 2], None]
    body = shares * legs.body * legs.radius * ring + [0.0, 0.0, legs.underside]
    return np.concatenate([pads.reshape(-1, 3), body.reshape(-1, 3)])


def engine() -> Any:
    """MuJoCo, or one line that names what is missing."""
    try:
        import mujoco
    except ImportError:
        msg = "physics needs the extra 'physics': pip install 'quadtree_lss[physics]'"
        raise NoPhysics(msg) from None
    return mujoco
