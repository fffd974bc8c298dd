# SPDX-License-Identifier: Apache-2.0
"""The table of parameters, section by section: type, default, unit, range and meaning of each."""

from __future__ import annotations

from dataclasses import dataclass

from quadtree_lss.onboard.config.limits import MOST_LEAVES, MOST_LEVELS
from quadtree_lss.onboard.config.parameter import declared as _p


@dataclass(frozen=True)
class DomainConfig:
    """Where the map lies and how finely it may be divided."""

    xmin: float = _p(-60.0, "western edge of the square domain", unit="m", low=-1e8, high=1e8)
    ymin: float = _p(-60.0, "southern edge of the square domain", unit="m", low=-1e8, high=1e8)
    size: float = _p(120.0, "side of the square domain", unit="m", low=0.01, high=1e5)
    min_level: int = _p(4, "level to which the tree is divided at start", low=0, high=MOST_LEVELS)
    max_level: int = _p(
        8,
        "finest level; a cell is size / 2^level. At 11 a landing site pass takes 1.3 GB, at 12 it"
        " would take five",
        low=0,
        high=MOST_LEVELS,
    )


@dataclass(frozen=True)
class LidarConfig:
    """What the lidar measures."""

    range_noise: float = _p(
        0.06, "standard deviation of a range (Eq. 13)", unit="m", low=1e-4, high=10.0
    )
    range_noise_per_metre: float = _p(
        0.0, "what each metre of range adds to this deviation", unit="", low=0.0, high=1.0
    )
    beam_divergence: float = _p(
        0.0,
        "standard deviation of the beam across its axis: on inclined ground its footprint is deep",
        unit="rad",
        low=0.0,
        high=0.1,
    )
    min_range: float = _p(0.5, "shorter ranges are no returns", unit="m", low=0.0, high=1e5)
    max_range: float = _p(5000.0, "longer ranges are no returns", unit="m", low=0.1, high=1e6)
    outlier_gate: float = _p(
        0.4,
        "returns no farther from a neighbour than this (or than five times the scan's usual"
        " spacing) hang together; fewer than three that do are noise; 0 keeps every return",
        unit="m",
        low=0.0,
        high=1000.0,
    )
    deskew: bool = _p(
        True, "a cloud with a time for each point is taken point by point, each at its own pose"
    )


@dataclass(frozen=True)
class FramesConfig:
    """Names of coordinate frames."""

    map: str = _p("map", "planet-fixed frame of poses and map, z up")
    body: str = _p(
        "",
        "what poses are of: must be an odometry's child frame, and is where the way to the lidar "
        "begins with mount.tf; empty takes an odometry's first child frame",
    )


@dataclass(frozen=True)
class PoseConfig:
    """How a scan finds the pose at its stamp."""

    source: str = _p(
        "pose",
        "poses come on nav/pose (PoseWithCovarianceStamped) or nav/odometry (Odometry); in a bag"
        " that has this type not, the other is taken",
        choices=("pose", "odometry"),
    )
    max_wait: float = _p(
        1.0, "a scan waits this long after arrival for its pose", unit="s", low=0.0, high=60.0
    )
    buffer: float = _p(30.0, "poses older than this are forgotten", unit="s", low=0.1, high=3600.0)
    max_gap: float = _p(
        1.5, "no interpolation between poses farther apart", unit="s", low=0.001, high=60.0
    )
    queue: int = _p(20, "scans that may wait for their pose or their turn", low=1, high=1000)
    correlation_time: float = _p(
        300.0,
        "time over which the pose's error is forgotten; 0 if it is another one in each scan",
        unit="s",
        low=0.0,
        high=1e6,
    )
    unknown_position_sigma: float = _p(
        0.1,
        "position standard deviation where the message says unknown",
        unit="m",
        low=0.0,
        high=1e3,
    )
    unknown_attitude_sigma_deg: float = _p(
        0.05,
        "attitude standard deviation where the message says unknown",
        unit="deg",
        low=0.0,
        high=90.0,
    )


@dataclass(frozen=True)
class MountConfig:
    """Where the lidar sits on the body, when poses are those of the body."""

    x: float = _p(0.0, "lidar's origin in body axes", unit="m", low=-1e3, high=1e3)
    y: float = _p(0.0, "lidar's origin in body axes", unit="m", low=-1e3, high=1e3)
    z: float = _p(0.0, "lidar's origin in body axes", unit="m", low=-1e3, high=1e3)
    roll_deg: float = _p(
        0.0,
        "from lidar to body axes, first: about the body's x (ROS's roll, pitch, yaw)",
        unit="deg",
        low=-360.0,
        high=360.0,
    )
    pitch_deg: float = _p(
        0.0,
        "from lidar to body axes, second: about the body's y",
        unit="deg",
        low=-360.0,
        high=360.0,
    )
    yaw_deg: float = _p(
        0.0,
        "from lidar to body axes, third: about the body's z",
        unit="deg",
        low=-360.0,
        high=360.0,
    )
    axes: str = _p(
        "same",
        "from the cloud's axes to the lidar's as pose or mount have them: flu_to_optical for clouds"
        " with x forward, y left, z up (REP 103) and the pose of an optical frame (z forward,"
        " x right, y down); optical_to_flu for the opposite",
        choices=("same", "flu_to_optical", "optical_to_flu"),
    )
    tf: bool = _p(
        False,
        "the mount comes from /tf_static, from the body's frame (frames.body) to that of the scans",
    )
    gimbal: bool = _p(
        False, "the mount comes from the topic lidar/gimbal, interpolated to each scan"
    )


@dataclass(frozen=True)
class MappingConfig:
    """Plane fit, fusion, division (paper IV)."""

    fit: str = _p(
        "height",
        "plane fit: height regression with a weak slope prior, or the paper's orthogonal ML fit",
        choices=("height", "ml"),
    )
    covariance: str = _p(
        "common",
        "pose error is common to a scan's points, or independent for each (the paper)",
        choices=("common", "independent"),
    )
    division: str = _p(
        "lack_of_fit",
        "division criterion: misfit over range noise, or the paper's Mahalanobis distance",
        choices=("lack_of_fit", "mahalanobis"),
    )
    division_factor: float = _p(
        1.2,
        "a cell divides above this multiple of the expected value (Eq. 47)",
        low=1.0,
        high=100.0,
    )
    division_confidence: float = _p(
        0.5,
        "by how many standard deviations the mean must exceed the threshold",
        low=0.0,
        high=10.0,
    )
    divide_exceptions: float = _p(
        1.5,
        "exceptions, in measurements, that show a rock and divide a leaf; 0 is off",
        low=0.0,
        high=1e6,
    )
    divide_area: float = _p(
        0.04,
        "points raised by features.divide_height over this area show a rock and divide a leaf; "
        "0 is off",
        unit="m^2",
        low=0.0,
        high=1e6,
    )
    division_min_residuals: int = _p(
        8,
        "free residuals (points less three a scan) before the statistic counts",
        low=1,
        high=100000,
    )
    align: bool = _p(True, "let each scan and the map meet at one height")
    min_points: int = _p(3, "points of one scan that make a first fit", low=3, high=10000)
    slope_prior_points: float = _p(
        5.0, "weight of the parent's slope in a first height fit, in points", low=0.0, high=1000.0
    )
    max_cells: int = _p(200000, "leaves the map may hold, at up to 1.5 kB", low=1, high=MOST_LEAVES)
    residual_clip: float = _p(
        1.0, "residuals count at most this much in running statistics", unit="m", low=0.01, high=1e3
    )
    roughness_tolerance: float = _p(
        0.3,
        "a measurement farther from its plane is an exception (Eq. 48)",
        unit="m",
        low=0.01,
        high=100.0,
    )
    noise_check: bool = _p(True, "warn when the observed range noise differs from the configured")


@dataclass(frozen=True)
class FeaturesConfig:
    """Subscale features (paper V.C)."""

    enabled: bool = _p(True, "estimate one subscale feature in each leaf that shows one")
    min_height: float = _p(0.1, "lower features are discarded", unit="m", low=0.0, high=100.0)
    divide_height: float = _p(
        0.15,
        "a feature this high (and three range noises) divides its leaf",
        unit="m",
        low=0.0,
        high=1e3,
    )
    divide_sigma: float = _p(
        0.5, "wider features divide nothing: they are no rocks", unit="m", low=0.0, high=1e3
    )
    min_volume: float = _p(
        0.002, "features of less volume (k^2) are discarded", unit="m^3", low=0.0, high=1e4
    )
    max_sigma_fraction: float = _p(
        0.3,
        "features wider (sigma) than this fraction of the cell are discarded",
        low=0.01,
        high=2.0,
    )
    min_points: int = _p(12, "points of one scan a cell needs for a feature", low=6, high=100000)


@dataclass(frozen=True)
class LssConfig:
    """Hazards, scoring and ranking (paper V)."""

    assessment: str = _p(
        "probability",
        "what ground is safe: where the risk of landing is at most max_risk; or where the touchdown"
        " check with its three limits finds nothing; or the paper's avoided features alone",
        choices=("probability", "touchdown", "paper"),
    )
    ranking: str = _p(
        "probability",
        "what sites are ranked by: the probability of a safe touchdown if the lander aims there,"
        " or the paper's score (Eq. 59)",
        choices=("probability", "score"),
    )
    max_risk: float = _p(
        0.003,
        "greatest probability that landing at a place fails there; with assessment probability",
        low=0.0,
        high=1.0,
        live=True,
    )
    dispersion: float = _p(
        2.0,
        "standard deviation, along x and along y, of where the lander comes down about its aim;"
        " what guidance says on landing/dispersion goes before it",
        unit="m",
        low=0.0,
        high=100.0,
        live=True,
    )
    risk_model: str = _p(
        "",
        "file of the fit that turns the worst rest on the map into a probability (fit-risk writes"
        " one); empty for the one that comes with the package",
    )
    grid_spacing: float = _p(0.5, "spacing of candidate sites", unit="m", low=0.01, high=1000.0)
    vehicle_diameter: float = _p(
        3.7, "diameter of the pads' circle", unit="m", low=0.1, high=1000.0
    )
    margin: float = _p(
        0.0,
        "guidance error added to the vehicle's radius",
        unit="m",
        low=0.0,
        high=1000.0,
        live=True,
    )
    max_slope_deg: float = _p(
        10.0,
        "steepest ground that the lander stands on; with assessment paper the slope tolerance of"
        " leaves, only shown with touchdown",
        unit="deg",
        low=0.1,
        high=89.0,
        live=True,
    )
    max_roughness: float = _p(
        0.3,
        "highest ground over its pads' plane that the lander clears; with assessment paper the"
        " elevation tolerance of leaves, only shown with touchdown",
        unit="m",
        low=0.01,
        high=100.0,
        live=True,
    )
    max_exception_fraction: float = _p(
        0.05,
        "a leaf with a larger share of exceptions is a hazard, with either assessment; since rocks "
        "divide leaves, few are left: finest ones, all at mapping.max_cells, and with "
        "mapping.divide_exceptions 0",
        low=0.0,
        high=1.0,
        live=True,
    )
    elevation_reference_size: float = _p(
        4.0,
        "cell size of the fused plane that leaves are compared with",
        unit="m",
        low=0.01,
        high=1e5,
    )
    touchdown_slope_deg: float = _p(
        9.0,
        "slope limit of the touchdown check on the map",
        unit="deg",
        low=0.1,
        high=89.0,
        live=True,
    )
    touchdown_roughness: float = _p(
        0.25,
        "roughness limit of the touchdown check on the map",
        unit="m",
        low=0.01,
        high=100.0,
        live=True,
    )
    touchdown_yaws: int = _p(12, "headings of the touchdown check", low=1, high=360)
    pad_radius: float = _p(0.15, "radius of a landing pad", unit="m", low=0.0, high=10.0)
    hazard_growth: float = _p(
        0.25,
        "unsafe ground is taken to reach this much farther: what the map's place is wrong by; "
        "rounded up to whole finest cells",
        unit="m",
        low=0.0,
        high=100.0,
        live=True,
    )
    max_gap: float = _p(
        0.6,
        "ground farther from any that is mapped is unseen",
        unit="m",
        low=0.0,
        high=1000.0,
        live=True,
    )
    weight_slope: float = _p(1.0, "alpha_theta of Eq. 58, per radian", low=0.0, high=1e6, live=True)
    weight_roughness: float = _p(
        2.0,
        "alpha_R of Eq. 58 over the leaf's area, per metre: as it is, a centimetre of roughness "
        "counts like a degree of slope",
        low=0.0,
        high=1e6,
        live=True,
    )
    weight_hazard_distance: float = _p(
        0.02, "alpha_H of Eq. 58, per metre", low=0.0, high=1e6, live=True
    )
    weight_subscale: float = _p(1.0, "alpha_s of Eq. 58, per metre", low=0.0, high=1e6, live=True)
    weight_target: float = _p(
        0.02,
        "added score per metre from the target, when one is given",
        low=0.0,
        high=1e6,
        live=True,
    )
    target_risk: float = _p(
        0.001,
        "what a metre nearer to the target is worth, as a probability of a safe touchdown, when"
        " sites are ranked by that",
        unit="1/m",
        low=0.0,
        high=1.0,
        live=True,
    )
    hazard_distance_cap: float = _p(
        10.0, "farther hazards do not improve a score", unit="m", low=0.1, high=1e5, live=True
    )
    sites: int = _p(5, "sites to rank", low=1, high=1000, live=True)
    min_separation: float = _p(
        3.7, "least distance between ranked sites", unit="m", low=0.0, high=1e5, live=True
    )
    required_input: str = _p(
        "none",
        "lss_node gives out no site before it has heard these topics of landing/: for a vehicle "
        "that flies with an area or a keep-out",
        choices=("none", "area", "keep_out", "both"),
    )
    max_map_age: float = _p(
        30.0,
        "lss_node withdraws its sites when no map it could use has come for longer; 0 is never",
        unit="s",
        low=0.0,
        high=1e5,
        live=True,
    )
    switch_margin: float = _p(
        0.01,
        "the target gives way to a site that is better by more than this, in the unit of the "
        "ranking: 0.01 is one per cent more probably safe; with ranking score 0.08 buys 4 m more "
        "room to the nearest hazard, or 4.6 degrees less slope",
        low=0.0,
        high=1e6,
        live=True,
    )
    hysteresis: float = _p(
        0.0,
        "each ranked site keeps its rank unless another scores better by this; 0 is off: the list "
        "follows from the map alone",
        low=0.0,
        high=1e6,
        live=True,
    )


@dataclass(frozen=True)
class QosConfig:
    """Quality of service of the inputs."""

    scan_reliability: str = _p(
        "best_effort",
        "best effort matches any publisher; reliable loses no scan",
        choices=("best_effort", "reliable"),
    )
    overload: str = _p(
        "newest",
        "when scans come faster than they can be mapped: leave out old ones, so that the map stays "
        "younger than diagnostics.warn_age, or map all, however late",
        choices=("newest", "all"),
    )
    scan_depth: int = _p(50, "scans the middleware may queue", low=1, high=1000)
    pose_depth: int = _p(200, "poses the middleware may queue", low=100, high=100000)


@dataclass(frozen=True)
class PublishConfig:
    """What the nodes send, and how often."""

    rate: float = _p(10.0, "map publications per second at most", unit="Hz", low=0.01, high=1000.0)
    lss_rate: float = _p(
        4.0, "landing site passes per second at most", unit="Hz", low=0.01, high=1000.0
    )
    marker_rate: float = _p(
        1.0,
        "markers and landing/grid_map for viewers per second at most, while somebody subscribes",
        unit="Hz",
        low=0.01,
        high=100.0,
    )
    diagnostics_rate: float = _p(1.0, "diagnostics per second", unit="Hz", low=0.01, high=100.0)


@dataclass(frozen=True)
class DiagnosticsConfig:
    """From which age on data are too old."""

    warn_age: float = _p(
        1.0,
        "the status warns when scans, poses or (lss_node) maps stay away for longer",
        unit="s",
        low=0.01,
        high=1e5,
        live=True,
    )
    error_age: float = _p(
        5.0,
        "the status is an error when they stay away for longer",
        unit="s",
        low=0.01,
        high=1e5,
        live=True,
    )


@dataclass(frozen=True)
class FilesConfig:
    """Where a node may read and write."""

    root: str = _p(
        "",
        "folder below which all files of a node must lie, links followed; relative paths are from "
        "it. Empty = wherever the paths given at the start lead",
    )


@dataclass(frozen=True)
class MapFileConfig:
    """Where the services ``~/save_map`` and ``~/load_map`` keep a map."""

    path: str = _p("", "file of the services save_map and load_map; empty = none")


@dataclass(frozen=True)
class CheckpointConfig:
    """The map on disk, taken up again when mapping_node starts."""

    path: str = _p("", "file of the checkpoints; empty = none are written or taken up")
    interval: float = _p(
        2.0, "least time between two checkpoints", unit="s", low=0.05, high=86400.0, live=True
    )
