# SPDX-License-Identifier: Apache-2.0
"""The configuration: all sections, conversion from and to dotted values, checks across sections."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import operator
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import SimpleNamespace

from quadtree_lss.onboard.config import sections
from quadtree_lss.onboard.config.limits import exceeded_limit
from quadtree_lss.onboard.config.parameter import ConfigError as ConfigError
from quadtree_lss.onboard.config.parameter import Parameter as Parameter
from quadtree_lss.onboard.config.parameter import Value, checked_value
from quadtree_lss.onboard.config.sections import DiagnosticsConfig as DiagnosticsConfig
from quadtree_lss.onboard.config.sections import DomainConfig as DomainConfig
from quadtree_lss.onboard.config.sections import LidarConfig as LidarConfig
from quadtree_lss.onboard.config.sections import LssConfig as LssConfig
from quadtree_lss.onboard.config.sections import MountConfig as MountConfig
from quadtree_lss.onboard.config.vehicle import VehicleConfig as VehicleConfig

#: Smallest domain.min_level of a domain that follows: a step is then at most an eighth of its side.
MIN_FOLLOW_LEVEL = 3

#: Removed parameters and sections, by what applies instead.
_REMOVED = {
    "vehicle.diameter replaces it": "lss.vehicle_diameter",
    "vehicle.clearance replaces it": "lss.max_roughness",
    "vehicle.max_slope_deg replaces it": "lss.max_slope_deg",
    "vehicle.pad_radius replaces it": "lss.pad_radius",
    "it follows from the vehicle (config explain vehicle)": "lidar.outlier_gate"
    " mapping.divide_area mapping.residual_clip mapping.roughness_tolerance features.min_height"
    " features.divide_height features.divide_sigma features.min_volume"
    " lss.elevation_reference_size lss.touchdown_slope_deg lss.touchdown_roughness"
    " lss.hazard_distance_cap lss.hazard_growth lss.min_separation",
    "lidar.stereo_noise is disparity_sigma / (focal_length baseline)": "lidar.disparity_sigma"
    " lidar.focal_length lidar.baseline lidar.noise_model",
    "lidar.range_noise is that of all ranges": "lidar.range_noise_per_metre lidar.beam_divergence",
    "lss.assessment probability ranks by probability, the others by score": "lss.ranking",
    "mount.source says the same": "mount.tf mount.gimbal",
    "mapping.paper says the same": "mapping.fit mapping.covariance mapping.division",
    "qos_overrides.TOPIC.subscription sets it": "qos.scan_depth qos.pose_depth"
    " qos.scan_reliability",
    "a greater diagnostics.warn_age maps later scans": "qos.overload",
    "DEVICE,BAUD in autopilot.connection sets it": "autopilot.baud",
    "its value is fixed": "pose.buffer pose.max_gap pose.queue lidar.depth_step lidar.depth_raw"
    " lidar.deskew mapping.align mapping.division_confidence mapping.divide_exceptions"
    " mapping.division_min_residuals mapping.min_points mapping.slope_prior_points"
    " mapping.noise_check features.enabled features.max_sigma_fraction features.min_points"
    " lss.weight_target lss.weight_slope lss.weight_roughness lss.weight_hazard_distance"
    " lss.weight_subscale lss.max_exception_fraction lss.touchdown_yaws lss.switch_margin"
    " lss.settle_share lss.target_risk lss.max_map_age lss.hysteresis publish.diagnostics_rate"
    " publish.marker_rate checkpoint.interval diagnostics.error_age autopilot.commit_height"
    " autopilot.control_sigma autopilot.max_heartbeat_age autopilot.max_pose_age"
    " autopilot.max_target_age autopilot.max_map_age autopilot.max_offset autopilot.max_jump"
    " autopilot.max_wave_offs autopilot.patience",
    "it has no effect; delete the line": "light prior lss.weight_shadow files.root",
}
REMOVED = {name: reason for reason, names in _REMOVED.items() for name in names.split()}


@dataclass(frozen=True)
class Config:
    """All parameters; the defaults are those of ``config/default.yaml``."""

    vehicle: VehicleConfig = field(default_factory=VehicleConfig)
    domain: DomainConfig = field(default_factory=DomainConfig)
    lidar: LidarConfig = field(default_factory=LidarConfig)
    frames: sections.FramesConfig = field(default_factory=sections.FramesConfig)
    pose: sections.PoseConfig = field(default_factory=sections.PoseConfig)
    mount: MountConfig = field(default_factory=MountConfig)
    mapping: sections.MappingConfig = field(default_factory=sections.MappingConfig)
    lss: LssConfig = field(default_factory=LssConfig)
    publish: sections.PublishConfig = field(default_factory=sections.PublishConfig)
    diagnostics: DiagnosticsConfig = field(default_factory=DiagnosticsConfig)
    map_file: sections.MapFileConfig = field(default_factory=sections.MapFileConfig)
    checkpoint: sections.CheckpointConfig = field(default_factory=sections.CheckpointConfig)
    autopilot: sections.AutopilotConfig = field(default_factory=sections.AutopilotConfig)

    def __post_init__(self) -> None:
        object.__setattr__(self, "lss", dataclasses.replace(self.lss, vehicle=self.vehicle))
        # Depth images have no isolated returns: their edges are removed on reception.
        depth, gate = self.lidar.source == "depth", self.vehicle.lengths.outlier_gate
        lidar = dataclasses.replace(self.lidar, outlier_gate=0.0 if depth else gate)
        object.__setattr__(self, "lidar", lidar)
        found = "; ".join(contradictions(self))
        if found:
            raise ConfigError(found)


_TYPES: dict[str, type] = {"bool": bool, "int": int, "float": float, "str": str}


@functools.cache
def parameters() -> tuple[Parameter, ...]:
    """All parameters in the order of their sections."""
    return tuple(
        Parameter(
            name=f"{section.name}.{item.name}",
            type=_TYPES[str(item.type)],
            default=item.default,  # type: ignore[arg-type]
            **item.metadata,
        )
        for section in dataclasses.fields(Config)
        for item in dataclasses.fields(section.default_factory)  # type: ignore[arg-type]
        if item.metadata
    )


def removal_reason(key: str) -> str:
    """Return what replaces a removed parameter; empty if it was not removed."""
    return REMOVED.get(key) or REMOVED.get(key.partition(".")[0], "")


def unknown_parameter(key: str) -> str:
    """Return the error text for an unknown name, with its replacement or the nearest name."""
    if reason := removal_reason(key):
        return f"{key} was removed: {reason}"
    names = [row.name for row in parameters()]
    near = difflib.get_close_matches(key, names, n=1, cutoff=0.0) if key.strip(" .") else []
    return f"unknown parameter '{key}'" + "".join(f"; did you mean '{name}'?" for name in near)


def flatten(values: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    """Convert nested or dotted keys to dotted ones."""
    flat: dict[str, object] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat.update(flatten(value, f"{prefix}{key}."))
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def checked_values(
    values: Mapping[str, object], faults: list[str] | None = None
) -> dict[str, dict[str, Value]]:
    """Convert dotted values to the types of their parameters, by section and name.

    ``faults`` receives the errors of single values, which are otherwise raised. Raises
    `ConfigError`: unknown key (see `unknown_parameter`), wrong type or range."""
    table = {row.name: row for row in parameters()}
    found: dict[str, dict[str, Value]] = {}
    for key, value in values.items():
        try:
            if key not in table:
                raise ConfigError(unknown_parameter(key))
            section, _, name = key.partition(".")
            found.setdefault(section, {})[name] = checked_value(table[key], value)
        except ConfigError as error:
            if faults is None:
                raise
            faults.append(str(error))
    return found


def config_from_values(values: Mapping[str, object], base: Config | None = None) -> Config:
    """Return ``base``, by default the defaults, with dotted or nested values set. Raises
    `ConfigError`: unknown key (names the nearest), wrong type or range, contradicting values."""
    start = Config() if base is None else base
    changed = {
        section: dataclasses.replace(getattr(start, section), **entries)
        for section, entries in checked_values(flatten(values)).items()
    }
    return dataclasses.replace(start, **changed)


def values_from_config(config: Config) -> dict[str, Value]:
    """Return the dotted values of a configuration."""
    return {row.name: operator.attrgetter(row.name)(config) for row in parameters()}


def contradictions(config: Config | SimpleNamespace) -> Iterator[str]:
    """Yield a line for each contradiction between parameters; ``lss.vehicle`` must be set."""
    domain, lidar, mapping = config.domain, config.lidar, config.mapping
    if not config.frames.map:
        yield "frames.map is empty: it is the name of the frame of poses and map"
    if domain.min_level > domain.max_level:
        yield f"domain.min_level = {domain.min_level} exceeds domain.max_level = {domain.max_level}"
    if 4**domain.min_level > mapping.max_cells:
        yield (
            f"mapping.max_cells = {mapping.max_cells} is less than the {4**domain.min_level}"
            f" cells of domain.min_level = {domain.min_level}"
        )
    if domain.follow != "none":
        yield from _cannot_follow(config)
    if lidar.min_range >= lidar.max_range:
        yield (
            f"lidar.min_range = {lidar.min_range} is not below lidar.max_range = {lidar.max_range}"
        )
    if (high := config.vehicle.clearance) > (wide := config.vehicle.diameter):
        yield f"vehicle.clearance = {high:g} m exceeds vehicle.diameter = {wide:g} m"
    mount = config.mount
    if mount.source != "fixed" and mount != MountConfig(source=mount.source, axes=mount.axes):
        yield f"mount.source is {mount.source}: leave mount.x ... mount.yaw_deg at 0"
    reason = exceeded_limit(domain.size, 1 << domain.max_level, config.lss)
    if reason is not None:
        yield f"domain.size = {domain.size:g} m, domain.max_level = {domain.max_level}: {reason}"


def _cannot_follow(config: Config | SimpleNamespace) -> Iterator[str]:
    """Yield the reason why the domain cannot follow, if there is one."""
    domain, step = config.domain, config.domain.step
    spacing = config.lss.spacing
    parts = max(round(step / spacing), 1)
    if domain.min_level < MIN_FOLLOW_LEVEL:
        yield (
            f"domain.follow moves the domain by coarsest cells, of {step:g} m, too much at once for"
            f" {domain.size:g} m: set domain.min_level to {MIN_FOLLOW_LEVEL} or more"
        )
    elif abs(step - parts * spacing) > 1e-6 * spacing:
        yield (
            f"domain.follow moves the domain by {step:g} m, which is not a multiple of"
            f" lss.grid_spacing = {spacing:g} m: set that to {step / parts:.12g}"
        )


#: The configuration without any file.
DEFAULTS = Config()
