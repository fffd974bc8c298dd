# SPDX-License-Identifier: Apache-2.0
"""The table of parameters: type, default, unit, range and meaning of each, by section."""

from __future__ import annotations

from dataclasses import dataclass

from quadtree_lss.onboard.config.limits import MAX_LEAVES, MAX_LEVEL, STEP_LEVEL
from quadtree_lss.onboard.config.parameter import declared as _p
from quadtree_lss.onboard.config.parameter import live as _live
from quadtree_lss.onboard.config.vehicle import Lengths, VehicleConfig


@dataclass(frozen=True)
class DomainConfig:
    """Position, size and resolution of the map."""

    xmin: float = _p(-60.0, "western edge of the square domain", (-1e8, 1e8), "m")
    ymin: float = _p(-60.0, "southern edge of the square domain", (-1e8, 1e8), "m")
    size: float = _p(120.0, "side of the square domain", (0.01, 1e5), "m")
    follow: str = _p(
        "none",
        "what the domain follows, by whole coarsest cells: vehicle (the lidar) or area (the middle"
        " of landing/area); ground outside is dropped",
        choices=("none", "vehicle", "area"),
    )
    min_level: int = _p(4, "level of the coarsest cells", (0, MAX_LEVEL))
    max_level: int = _p(
        8,
        "level of the finest cells: size / 2^level; an assessment takes 1.3 GB at 11",
        (0, MAX_LEVEL),
    )

    @property
    def step(self) -> float:
        """Step of a domain that follows, m."""
        return self.size / (1 << min(self.min_level, STEP_LEVEL))


@dataclass(frozen=True)
class LidarConfig:
    """Lidar or depth camera."""

    source: str = _p(
        "points",
        "topic of the scans: lidar/points, or depth/image with depth/camera_info; a bag without"
        " this type uses the other",
        choices=("points", "depth"),
    )
    range_noise: float = _p(0.06, "standard deviation of a range", (1e-4, 10.0), "m")
    stereo_noise: float = _p(
        0.0,
        "standard deviation of a stereo depth over its square: that of the disparity over focal"
        " length and baseline; 0 is no stereo",
        (0.0, 1.0),
        "1/m",
    )
    min_range: float = _p(0.5, "shorter ranges are ignored", (0.0, 1e5), "m")
    max_range: float = _p(5000.0, "longer ranges are ignored", (0.1, 1e6), "m")
    #: Not a parameter: returns closer than this, m, or than five times the usual spacing of the
    #: scan, form a group; a group of fewer than three is noise. 0 keeps every return.
    outlier_gate: float = Lengths.outlier_gate


@dataclass(frozen=True)
class FramesConfig:
    """Names of coordinate frames."""

    map: str = _p("map", "frame of poses and map, z up")
    body: str = _p(
        "",
        "frame of the body: child frame of the odometry, and start of the transforms to the lidar"
        " with mount.source tf; empty for the first child frame",
    )


@dataclass(frozen=True)
class PoseConfig:
    """Poses and their errors."""

    source: str = _p(
        "pose",
        "topic of the poses: nav/pose or nav/odometry; a bag without this type uses the other",
        choices=("pose", "odometry"),
    )
    max_wait: float = _p(1.0, "time after arrival that a scan waits for its pose", (0.0, 60.0), "s")
    correlation_time: float = _p(
        300.0,
        "correlation time of pose errors; 0 if they are independent from scan to scan",
        (0.0, 1e6),
        "s",
    )
    unknown_position_sigma: float = _p(
        0.1, "position standard deviation where a message has none", (0.0, 1e3), "m"
    )
    unknown_attitude_sigma_deg: float = _p(
        0.05, "attitude standard deviation where a message has none", (0.0, 90.0), "deg"
    )

    @property
    def queue(self) -> int:
        """Number of scans that may wait for their pose, for a lidar of 20 Hz."""
        return max(20, round(20.0 * self.max_wait))


@dataclass(frozen=True)
class MountConfig:
    """Mount of the lidar on the body, if poses are those of the body."""

    x: float = _p(0.0, "origin of the lidar in body axes", (-1e3, 1e3), "m")
    y: float = _p(0.0, "origin of the lidar in body axes", (-1e3, 1e3), "m")
    z: float = _p(0.0, "origin of the lidar in body axes", (-1e3, 1e3), "m")
    roll_deg: float = _p(
        0.0,
        "rotation from lidar to body axes, first about x (roll, pitch, yaw as in ROS)",
        (-360.0, 360.0),
        "deg",
    )
    pitch_deg: float = _p(0.0, "then about the y axis of the body", (-360.0, 360.0), "deg")
    yaw_deg: float = _p(0.0, "then about the z axis of the body", (-360.0, 360.0), "deg")
    axes: str = _p(
        "same",
        "from the axes of the cloud to those of pose or mount: flu_to_optical from x forward, y"
        " left, z up (REP 103) to z forward, x right, y down; optical_to_flu is the opposite",
        choices=("same", "flu_to_optical", "optical_to_flu"),
    )
    source: str = _p(
        "fixed",
        "source of the mount: fixed, the parameters above; tf, /tf_static from frames.body to the"
        " frame of the scans; gimbal, the topic lidar/gimbal",
        choices=("fixed", "tf", "gimbal"),
    )


@dataclass(frozen=True)
class MappingConfig:
    """Plane fit, fusion, division (paper IV)."""

    paper: str = _p(
        "none",
        "rule of the paper that replaces the default one, for comparison: fit by orthogonal"
        " distance; covariance with independent pose errors; division by Mahalanobis distance",
        choices=("none", "fit", "covariance", "division", "all"),
    )
    division_factor: float = _p(
        1.2, "a cell divides above this multiple of the expected residual", (1.0, 100.0)
    )
    max_cells: int = _p(200000, "most leaves, of up to 1.5 kB each", (1, MAX_LEAVES))

    def by_paper(self, rule: str) -> bool:
        """Whether the paper's ``rule`` (fit, covariance or division) replaces the default one."""
        return self.paper in (rule, "all")


@dataclass(frozen=True)
class LssConfig:
    """Hazards, scoring and ranking (paper V)."""

    assessment: str = _p(
        "probability",
        "rule for safe ground: predicted risk at most max_risk; the touchdown check with fixed"
        " limits; or the paper's hazards. Sites are ranked by probability of success with the"
        " first, otherwise by the paper's score",
        choices=("probability", "touchdown", "paper"),
    )
    max_risk: float = _live(
        0.003, "greatest predicted risk of safe ground, with assessment probability", (0.0, 1.0)
    )
    dispersion: float = _live(
        2.0,
        "standard deviation of the touchdown along x and y; landing/dispersion replaces it",
        (0.0, 100.0),
        "m",
    )
    risk_model: str = _p(
        "", "file of the risk model, written by fit-risk; empty for the one of the package"
    )
    grid_spacing: float = _p(
        0.0, "spacing of grid points; 0 follows from the vehicle", (0.0, 1000.0), "m"
    )
    margin: float = _live(
        0.0, "guidance error, added to the radius of the vehicle", (0.0, 1000.0), "m"
    )
    max_gap: float = _live(
        -1.0,
        "wider gaps of the map are unobserved; below 0 it follows from the vehicle",
        (-1.0, 1000.0),
        "m",
    )
    sites: int = _live(5, "number of ranked sites", (1, 1000))
    required_input: str = _p(
        "none",
        "topics of landing/ without which lss_node gives no site",
        choices=("none", "area", "keep_out", "both"),
    )
    min_probability: float = _live(
        0.9, "least probability of success of a target, with assessment probability", (0.0, 1.0)
    )
    settle_time: float = _live(
        5.0,
        "no target before this time since the first map, unless 63 % of the area, or of the"
        " domain, is observed",
        (0.0, 1e5),
        "s",
    )
    commit_height: float = _live(
        20.0,
        "height over the target below which no better site replaces it; needs poses",
        (0.0, 1e5),
        "m",
    )
    #: Not a parameter: the section ``vehicle``.
    vehicle: VehicleConfig = VehicleConfig()

    @property
    def ranking(self) -> str:
        """Ranking of sites: ``probability``, or the paper's ``score``."""
        return "probability" if self.assessment == "probability" else "score"

    @property
    def zone(self) -> float:
        """Radius of the landing zone, m."""
        return 0.5 * self.vehicle.diameter + self.margin

    @property
    def spacing(self) -> float:
        """Spacing of grid points, m."""
        return self.grid_spacing or self.vehicle.lengths.grid_spacing

    @property
    def gap(self) -> float:
        """Width of gaps above which ground is unobserved, m."""
        return self.vehicle.lengths.max_gap if self.max_gap < 0.0 else self.max_gap


@dataclass(frozen=True)
class PublishConfig:
    """Rates of publication."""

    rate: float = _p(10.0, "greatest rate of maps", (0.01, 1000.0), "Hz")
    lss_rate: float = _p(4.0, "greatest rate of assessments", (0.01, 1000.0), "Hz")


@dataclass(frozen=True)
class DiagnosticsConfig:
    """Limits of the age of data."""

    warn_age: float = _live(
        1.0,
        "age of scans, poses or maps for a warning; an error at five times this age",
        (0.01, 1e5),
        "s",
    )

    @property
    def error_age(self) -> float:
        """Age of scans, poses or maps for an error, s."""
        return 5.0 * self.warn_age


@dataclass(frozen=True)
class MapFileConfig:
    """File of the services ``~/save_map`` and ``~/load_map``."""

    path: str = _p("", "file of save_map and load_map")


CHECKPOINT_S = 2.0
"""Shortest time between checkpoints: at most two seconds of scans are lost with a killed node."""


@dataclass(frozen=True)
class CheckpointConfig:
    """File from which mapping_node restores the map when it starts."""

    path: str = _p("", "file of the checkpoints; empty for none")


@dataclass(frozen=True)
class AutopilotConfig:
    """Landing with a MAVLink autopilot."""

    connection: str = _p(
        "udpin:127.0.0.1:14550",
        "MAVLink: udpin:ADDRESS:PORT, udpout:ADDRESS:PORT, tcp:ADDRESS:PORT, or a serial device,"
        " as DEVICE or DEVICE,BAUD (default 921600)",
    )
    may_command: str = _p(
        "nothing",
        "commands besides set-points: modes, guided or offboard on ~/land, and land mode on the"
        " ground (ArduPilot); arming, the same and disarming on the ground",
        choices=("nothing", "modes", "arming"),
    )
    odometry: bool = _p(
        True,
        "publish nav/odometry; false if another node publishes poses in the local frame of the"
        " autopilot, in east, north, up",
    )
    gate_height: float = _live(
        8.0,
        "height of the gate over the target; below a quarter of it the vehicle commits",
        (0.5, 1e3),
        "m",
    )
    transit_speed: float = _live(3.0, "speed to the gate, and up", (0.1, 50.0), "m/s")
    descent_speed: float = _live(
        1.0, "speed from the gate to a quarter of its height", (0.05, 20.0), "m/s"
    )
    touchdown_speed: float = _live(0.4, "speed from there to the ground", (0.05, 5.0), "m/s")
    reach: float = _live(
        50.0,
        "greatest distance of a target from where the pilot hands over; published as"
        " landing/area unless another node does",
        (1.0, 1e5),
        "m",
    )
