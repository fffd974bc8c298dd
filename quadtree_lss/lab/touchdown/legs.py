# SPDX-License-Identifier: Apache-2.0
"""A vehicle on legs or skids as a physics model, as text for MuJoCo.

One rigid body with its centre of mass above the middle of its pads. Under it feet slide along the
body's axis: four pads on a circle, as the static contact has them (`simulation.safety`), or two
skids that join them in pairs. A strut gives way at its crush force and stays crushed (dry friction
of its joint), or is a spring with a damper, up to its stroke. Lengths are those of the struts
uncrushed, and so is the clearance but for `Legs.lift`. The ground pushes the feet alone: the judge
sees that it reaches into the body, and struts pass through it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadtree_lss.lab.simulation.safety import LandingGear
from quadtree_lss.onboard.arrays import Array

STEP = 6.6e-4
"""Of time, over the square root of diameter over gravity: 1 ms of the lander."""
CONTACT, STRUT = 10.0, 4.0
"""Time constants of contacts and of dry friction, steps: shorter contacts chatter, and crush struts
by that."""
FOOT = 0.01
"""Mass of a foot over that of the vehicle."""
RIM = 0.2
"""A pad is a flat ellipsoid with eight balls on its rim, of this share of its radius. A disc with a
sharp rim would be caught by the edges between the field's prisms."""
DEEP = 5.0
"""Ground below the lowest post, m."""


@dataclass(frozen=True)
class Legs:
    """What touches down; kg, m, N, s.

    Attributes:
        gear: Circle of the pads, radius of a pad (of a skid's bar), clearance under the body.
        mass, gravity: At touchdown; of the body landed on, m/s^2.
        centre: Height of the centre of mass over the pads.
        gyration: Radii of gyration about the body's axes across (x, y) and along (z).
        body: Radius of the body over that of the pads' circle.
        lift: Of the body's underside over the clearance: the stroke where that is of crushed
            struts.
        friction: Of feet on the ground.
        crush: Force at which a strut gives way, 0 for springs; of each foot.
        stiffness, damping: Of springs, N/m, N s/m.
        stroke: That a strut gives way at most.
        skids: Two bars instead of four pads.
    """

    gear: LandingGear = LandingGear()
    mass: float = 1760.0
    gravity: float = 1.62
    centre: float = 1.3
    gyration: tuple[float, float] = (1.0, 0.9)
    body: float = 0.7
    lift: float = 0.0
    friction: float = 0.5
    crush: float = 6000.0
    stiffness: float = 0.0
    damping: float = 0.0
    stroke: float = 0.25
    skids: bool = False

    @property
    def radius(self) -> float:
        """Of the circle on which the pads stand."""
        return 0.5 * self.gear.diameter

    @property
    def underside(self) -> float:
        """Of the body over the pads, struts uncrushed."""
        return self.gear.max_roughness + self.lift

    @property
    def step(self) -> float:
        """Of the engine's time, s."""
        return STEP * float(np.sqrt(self.gear.diameter / self.gravity))

    @property
    def pads(self) -> Array:
        """(4, 3) middles of the pads' undersides, body frame, whose origin is amid them."""
        angles = np.pi * (0.25 + 0.5 * np.arange(4))
        return self.radius * np.stack([np.cos(angles), np.sin(angles), np.zeros(4)], axis=1)

    def model(self, rows: int, columns: int, size: tuple[float, float], relief: float) -> str:
        """MJCF of the vehicle over a height field of so many posts.

        ``size`` is the field's half width along x and y, ``relief`` what its unit of height is, m.
        """
        pads = self.pads
        feet = [pads[[0, 1]], pads[[2, 3]]] if self.skids else [pads[[k]] for k in range(4)]
        body = self.mass * (1.0 - FOOT * len(feet))
        across, along = (body * k * k for k in self.gyration)
        parts = "".join(self._foot(k, ends) for k, ends in enumerate(feet))
        return f"""<mujoco>
 <option timestep="{self.step}" gravity="0 0 {-self.gravity}" integrator="implicitfast"
  cone="elliptic" impratio="10"><flag energy="enable"/></option>
 <default><geom friction="{self.friction} 0.005 0.0001" solref="{CONTACT * self.step} 1"
  solimp="0.95 0.99 0.001"/></default>
 <asset><hfield name="ground" nrow="{rows}" ncol="{columns}"
  size="{size[0]} {size[1]} {relief} {DEEP}"/></asset>
 <worldbody><geom name="ground" type="hfield" hfield="ground"/>
  <body name="vehicle"><freejoint/>
   <inertial pos="0 0 {self.centre * self.mass / body}" mass="{body}"
    diaginertia="{across} {across} {along}"/>{parts}
  </body></worldbody></mujoco>"""

    def _foot(self, number: int, ends: Array) -> str:
        """A pad, or a bar between two of them, on its strut."""
        x, y, _ = ends.mean(axis=0)
        thick = self.gear.pad_radius
        if self.skids:
            half = 0.5 * (ends[1] - ends[0])
            tips = " ".join(f"{v}" for v in (*(-half[:2]), thick, *half[:2], thick))
            shapes = [f'type="capsule" size="{thick}" fromto="{tips}"']
        else:
            rim = thick * np.exp(0.25j * np.pi * np.arange(8))
            low = RIM * thick
            shapes = [f'type="ellipsoid" size="{thick} {thick} {low}" pos="0 0 {low}"']
            shapes += [f'type="sphere" size="{low}" pos="{p.real} {p.imag} {low}"' for p in rim]
        geoms = "".join(f"\n    <geom {shape}/>" for shape in shapes)
        inertia = self.mass * FOOT * thick**2
        return f"""
   <body name="foot{number}" pos="{x} {y} 0">
    <inertial pos="0 0 0" mass="{self.mass * FOOT}" diaginertia="{inertia} {inertia} {inertia}"/>
    <joint name="strut{number}" type="slide" axis="0 0 1" limited="true" range="0 {self.stroke}"
     frictionloss="{self.crush}" stiffness="{self.stiffness}" damping="{self.damping}"
     solreflimit="{STRUT * self.step} 1" solreffriction="{STRUT * self.step} 1"
     solimpfriction="0.99 0.999 0.001"/>{geoms}</body>"""


LANDER = Legs()
"""The lander of the closed loop (`flight.vehicle`) with what propellant it comes down with."""
DRONE = Legs(
    gear=LandingGear(0.6, 0.02, 10.0, 0.08),
    mass=2.5,
    gravity=9.80665,
    centre=0.14,
    gyration=(0.12, 0.16),
    body=0.5,
    crush=0.0,
    stiffness=1500.0,
    damping=30.0,
    stroke=0.03,
    skids=True,
)
"""A quadrotor on skids, of the measures of ``config/drone.yaml``."""
