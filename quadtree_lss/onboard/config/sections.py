# SPDX-License-Identifier: Apache-2.0
"""The table of parameters, section by section: type, default, unit, range and meaning of each."""

from __future__ import annotations

from dataclasses import dataclass

from quadtree_lss.onboard.config.limits import MOST_LEAVES, MOST_LEVELS, STEP_LEVEL
from quadtree_lss.onboard.config.parameter import declared as _p
from quadtree_lss.onboard.config.parameter import live as _live
from quadtree_lss.onboard.config.vehicle import Lengths, VehicleConfig


@dataclass(frozen=True)
class DomainConfig:
    """Where the map lies and how finely it may be divided."""

    xmin: float = _p(-60.0, "western edge of the square domain", (-1e8, 1e8), "m")
    ymin: float = _p(-60.0, "southern edge of the square domain", (-1e8, 1e8), "m")
    size: float = _p(120.0, "side of the square domain", (0.01, 1e5), "m")
    follow: str = _p(
        "none",
        "the square moves by whole coarsest cells, so that this stays near its middle: vehicle (the"
        " lidar), or area (the middle of landing/area); what it leaves behind is dropped",
        choices=("none", "vehicle", "area"),
    )
    min_level: int = _p(4, "level to which the tree is divided at start", (0, MOST_LEVELS))
    max_level: int = _p(
        8,
        "finest level; a cell is size / 2^level. At 11 a landing site pass takes 1.3 GB, at 12 it"
        " would take five",
        (0, MOST_LEVELS),
    )

    @property
    def step(self) -> float:
        """A domain that follows is moved by multiples of this, m."""
        return self.size / (1 << min(self.min_level, STEP_LEVEL))


@dataclass(frozen=True)
class LidarConfig:
    """What the lidar, or the depth camera, measures."""

    source: str = _p(
        "points",
        "scans come on lidar/points (PointCloud2), or on depth/image (Image, 16UC1 in mm"
        " or 32FC1 in m) with depth/camera_info; a bag without this type uses the other",
        choices=("points", "depth"),
    )
    range_noise: float = _p(0.06, "standard deviation of a range (Eq. 13)", (1e-4, 10.0), "m")
    stereo_noise: float = _p(
        0.0,
        "what the square of the depth adds, of two cameras: the deviation of a disparity over the"
        " product of focal length and baseline; 0 is no stereo",
        (0.0, 1.0),
        "1/m",
    )
    min_range: float = _p(0.5, "shorter ranges are no returns", (0.0, 1e5), "m")
    max_range: float = _p(5000.0, "longer ranges are no returns", (0.1, 1e6), "m")
    #: No parameter: returns nearer to a neighbour than this, m, or than five times the scan's usual
    #: spacing, form a group; a group of fewer than three is noise. 0 keeps every return.
    outlier_gate: float = Lengths.outlier_gate


@dataclass(frozen=True)
class FramesConfig:
    """Names of coordinate frames."""

    map: str = _p("map", "planet-fixed frame of poses and map, z up")
    body: str = _p(
        "",
        "frame whose poses are sent: an odometry's child frame, and with mount.source tf the"
        " start of the chain to the lidar; empty takes an odometry's first child frame",
    )


@dataclass(frozen=True)
class PoseConfig:
    """How a scan finds the pose at its stamp."""

    source: str = _p(
        "pose",
        "poses come on nav/pose (PoseWithCovarianceStamped) or nav/odometry (Odometry); a"
        " bag without this type uses the other",
        choices=("pose", "odometry"),
    )
    max_wait: float = _p(1.0, "a scan waits this long after arrival for its pose", (0.0, 60.0), "s")
    correlation_time: float = _p(
        300.0,
        "how long an error of the pose lasts; 0 if each scan has another one",
        (0.0, 1e6),
        "s",
    )
    unknown_position_sigma: float = _p(
        0.1, "position standard deviation if the message says unknown", (0.0, 1e3), "m"
    )
    unknown_attitude_sigma_deg: float = _p(
        0.05, "attitude standard deviation if the message says unknown", (0.0, 90.0), "deg"
    )

    @property
    def queue(self) -> int:
        """Scans that may wait for their pose or their turn: those of a lidar of 20 Hz."""
        return max(20, round(20.0 * self.max_wait))


@dataclass(frozen=True)
class MountConfig:
    """Where the lidar sits on the body, when poses are those of the body."""

    x: float = _p(0.0, "lidar's origin in body axes", (-1e3, 1e3), "m")
    y: float = _p(0.0, "lidar's origin in body axes", (-1e3, 1e3), "m")
    z: float = _p(0.0, "lidar's origin in body axes", (-1e3, 1e3), "m")
    roll_deg: float = _p(
        0.0,
        "from lidar to body axes, first: about the body's x (ROS's roll, pitch, yaw)",
        (-360.0, 360.0),
        "deg",
    )
    pitch_deg: float = _p(
        0.0, "from lidar to body axes, second: about the body's y", (-360.0, 360.0), "deg"
    )
    yaw_deg: float = _p(
        0.0, "from lidar to body axes, third: about the body's z", (-360.0, 360.0), "deg"
    )
    axes: str = _p(
        "same",
        "from the cloud's axes to the lidar's as pose or mount have them: flu_to_optical for clouds"
        " with x forward, y left, z up (REP 103) and the pose of an optical frame (z forward,"
        " x right, y down); optical_to_flu for the opposite",
        choices=("same", "flu_to_optical", "optical_to_flu"),
    )
    source: str = _p(
        "fixed",
        "where the mount comes from: fixed, the above; tf, /tf_static from the body's frame"
        " (frames.body) to that of the scans; gimbal, the topic lidar/gimbal, interpolated to each"
        " scan",
        choices=("fixed", "tf", "gimbal"),
    )


@dataclass(frozen=True)
class MappingConfig:
    """Plane fit, fusion, division (paper IV)."""

    paper: str = _p(
        "none",
        "which of the paper's rules hold instead of ours, to compare: fit, orthogonal ML for height"
        " regression with a weak slope prior; covariance, pose errors independent for each point,"
        " not common to a scan's; division, by the Mahalanobis distance and not by misfit over"
        " range noise; all three",
        choices=("none", "fit", "covariance", "division", "all"),
    )
    division_factor: float = _p(
        1.2, "a cell divides above this multiple of the expected value (Eq. 47)", (1.0, 100.0)
    )
    max_cells: int = _p(200000, "leaves the map may hold, at up to 1.5 kB", (1, MOST_LEAVES))

    def by_paper(self, rule: str) -> bool:
        """Whether the paper's fit, covariance or division holds."""
        return self.paper in (rule, "all")


@dataclass(frozen=True)
class LssConfig:
    """Hazards, scoring and ranking (paper V)."""

    assessment: str = _p(
        "probability",
        "what ground is safe: where the risk of landing is at most max_risk; or where the touchdown"
        " check with its three limits finds nothing; or only the paper's avoided features. With"
        " probability sites are ranked by the probability of a safe touchdown if the lander aims"
        " there, otherwise by the paper's score (Eq. 59)",
        choices=("probability", "touchdown", "paper"),
    )
    max_risk: float = _live(
        0.003,
        "greatest probability that landing at a place fails there; with assessment probability",
        (0.0, 1.0),
    )
    dispersion: float = _live(
        2.0,
        "standard deviation, along x and along y, of the touchdown about the aim;"
        " landing/dispersion replaces it",
        (0.0, 100.0),
        "m",
    )
    risk_model: str = _p(
        "",
        "file of the fit that turns the worst rest on the map into a probability (fit-risk writes"
        " one); empty for the one that comes with the package",
    )
    grid_spacing: float = _p(
        0.0, "spacing of candidate sites; 0 follows from the vehicle", (0.0, 1000.0), "m"
    )
    margin: float = _live(0.0, "guidance error added to the vehicle's radius", (0.0, 1000.0), "m")
    max_gap: float = _live(
        -1.0,
        "ground farther from any that is mapped is unseen; below 0 it follows from the vehicle",
        (-1.0, 1000.0),
        "m",
    )
    sites: int = _live(5, "sites to rank", (1, 1000))
    required_input: str = _p(
        "none",
        "lss_node gives out no site before it has heard these topics of landing/: for a vehicle "
        "that flies with an area or a keep-out",
        choices=("none", "area", "keep_out", "both"),
    )
    min_probability: float = _live(
        0.9,
        "there is no target where a touchdown is less probably safe; with assessment probability",
        (0.0, 1.0),
    )
    settle_time: float = _live(
        5.0,
        "no target before this time has passed since the first map, or 63 % of the area, or of"
        " the domain, is seen",
        (0.0, 1e5),
        "s",
    )
    commit_height: float = _live(
        20.0,
        "below this height over the target only a hazard or a request takes it away, not"
        " a better site; lss_node needs poses for it",
        (0.0, 1e5),
        "m",
    )
    #: No parameter: what lands, of the section ``vehicle``.
    vehicle: VehicleConfig = VehicleConfig()

    @property
    def ranking(self) -> str:
        """How sites are ranked: by ``probability`` or by the paper's ``score``."""
        return "probability" if self.assessment == "probability" else "score"

    @property
    def zone(self) -> float:
        """Radius of the landing zone, m."""
        return 0.5 * self.vehicle.diameter + self.margin

    @property
    def spacing(self) -> float:
        """Of candidate sites, m."""
        return self.grid_spacing or self.vehicle.lengths.grid_spacing

    @property
    def gap(self) -> float:
        """Ground farther from any that is mapped is unseen, m."""
        return self.vehicle.lengths.max_gap if self.max_gap < 0.0 else self.max_gap


@dataclass(frozen=True)
class PublishConfig:
    """What the nodes send, and how often."""

    rate: float = _p(10.0, "map publications per second at most", (0.01, 1000.0), "Hz")
    lss_rate: float = _p(4.0, "landing site passes per second at most", (0.01, 1000.0), "Hz")


@dataclass(frozen=True)
class DiagnosticsConfig:
    """From which age on data are too old."""

    warn_age: float = _live(
        1.0,
        "the status warns when scans, poses or (lss_node) maps stay away for longer; it is an error"
        " when they do for five times as long",
        (0.01, 1e5),
        "s",
    )

    @property
    def error_age(self) -> float:
        """From which age on the status is an error, s."""
        return 5.0 * self.warn_age


@dataclass(frozen=True)
class MapFileConfig:
    """Where the services ``~/save_map`` and ``~/load_map`` keep a map."""

    path: str = _p("", "file of the services save_map and load_map; empty = none")


CHECKPOINT_S = 2.0
"""Least time between two checkpoints: what a killed node has lost is seen anew in as long, and the
disk has two seconds for some megabytes."""


@dataclass(frozen=True)
class CheckpointConfig:
    """The map on disk, taken up again when mapping_node starts."""

    path: str = _p("", "file of the checkpoints; empty = none are written or taken up")


@dataclass(frozen=True)
class AutopilotConfig:
    """How autopilot_node lands by a MAVLink autopilot."""

    connection: str = _p(
        "udpin:127.0.0.1:14550",
        "the autopilot's MAVLink: udpin:ADDRESS:PORT, udpout:ADDRESS:PORT, tcp:ADDRESS:PORT, or a"
        " serial device, at 921600 baud or as DEVICE,BAUD says",
    )
    may_command: str = _p(
        "nothing",
        "commands besides set-points: nothing; modes: guided or offboard on ~/land, land"
        " mode once on the ground (ArduPilot); arming: the same, and disarming once on the"
        " ground",
        choices=("nothing", "modes", "arming"),
    )
    odometry: bool = _p(
        True,
        "send the autopilot's pose on nav/odometry; false if another node sends poses, in"
        " the autopilot's local frame in east, north, up",
    )
    gate_height: float = _live(
        8.0,
        "of the gate over the target, to which a wave-off climbs; below a quarter of it the vehicle"
        " comes down for good",
        (0.5, 1e3),
        "m",
    )
    transit_speed: float = _live(3.0, "to the gate, and up", (0.1, 50.0), "m/s")
    descent_speed: float = _live(
        1.0, "from the gate to a quarter of its height", (0.05, 20.0), "m/s"
    )
    touchdown_speed: float = _live(0.4, "from there to the ground", (0.05, 5.0), "m/s")
    reach: float = _live(
        50.0,
        "targets farther from where the pilot handed over are not flown to; sent as landing/area"
        " where nobody else sends one",
        (1.0, 1e5),
        "m",
    )
