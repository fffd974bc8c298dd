# SPDX-License-Identifier: Apache-2.0
"""The configuration: all sections together, from and to values by name, checked as a whole."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import SimpleNamespace

from quadtree_lss.onboard.config.limits import why_too_much
from quadtree_lss.onboard.config.parameter import ConfigError, Parameter, Value, checked_value
from quadtree_lss.onboard.config.sections import (
    CheckpointConfig,
    DiagnosticsConfig,
    DomainConfig,
    FeaturesConfig,
    FilesConfig,
    FramesConfig,
    LidarConfig,
    LssConfig,
    MapFileConfig,
    MappingConfig,
    MountConfig,
    PoseConfig,
    PublishConfig,
    QosConfig,
)

__all__ = [
    "CheckpointConfig",
    "Config",
    "ConfigError",
    "DiagnosticsConfig",
    "DomainConfig",
    "FeaturesConfig",
    "FilesConfig",
    "FramesConfig",
    "LidarConfig",
    "LssConfig",
    "MapFileConfig",
    "MappingConfig",
    "MountConfig",
    "Parameter",
    "PoseConfig",
    "PublishConfig",
    "QosConfig",
    "Value",
    "checked_value",
    "config_from_values",
    "contradictions",
    "flatten",
    "nearest_key",
    "parameters",
    "values_from_config",
]


@dataclass(frozen=True)
class Config:
    """Everything that can be set; defaults are those of ``config/default.yaml``."""

    domain: DomainConfig = field(default_factory=DomainConfig)
    lidar: LidarConfig = field(default_factory=LidarConfig)
    frames: FramesConfig = field(default_factory=FramesConfig)
    pose: PoseConfig = field(default_factory=PoseConfig)
    mount: MountConfig = field(default_factory=MountConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    features: FeaturesConfig = field(default_factory=FeaturesConfig)
    lss: LssConfig = field(default_factory=LssConfig)
    qos: QosConfig = field(default_factory=QosConfig)
    publish: PublishConfig = field(default_factory=PublishConfig)
    diagnostics: DiagnosticsConfig = field(default_factory=DiagnosticsConfig)
    files: FilesConfig = field(default_factory=FilesConfig)
    map_file: MapFileConfig = field(default_factory=MapFileConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)

    def __post_init__(self) -> None:
        found = "; ".join(contradictions(self))
        if found:
            raise ConfigError(found)


_TYPES: dict[str, type] = {"bool": bool, "int": int, "float": float, "str": str}


def parameters() -> tuple[Parameter, ...]:
    """All parameters in the order of their sections."""
    return tuple(_rows())


def _rows() -> Iterator[Parameter]:
    default = Config()
    for section in dataclasses.fields(Config):
        values = getattr(default, section.name)
        for item in dataclasses.fields(values):
            meta = item.metadata
            yield Parameter(
                name=f"{section.name}.{item.name}",
                type=_TYPES[str(item.type)],
                default=getattr(values, item.name),
                unit=meta["unit"],
                low=meta["low"],
                high=meta["high"],
                choices=meta["choices"],
                live=meta["live"],
                doc=meta["doc"],
            )


def nearest_key(key: str) -> str:
    """The known parameter name most like ``key``."""
    names = [row.name for row in parameters()]
    close = difflib.get_close_matches(key, names, n=1, cutoff=0.0)
    return close[0]


def flatten(values: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    """Nested or dotted keys to dotted ones."""
    flat: dict[str, object] = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat.update(flatten(value, f"{name}."))
        else:
            flat[name] = value
    return flat


def config_from_values(values: Mapping[str, object], base: Config | None = None) -> Config:
    """A configuration from dotted or nested values laid over ``base``.

    Raises:
        ConfigError: unknown key (names the nearest), wrong type or range, values that
            contradict one another.
    """
    table = {row.name: row for row in parameters()}
    sections: dict[str, dict[str, Value]] = {}
    for key, value in flatten(values).items():
        if key not in table:
            msg = f"unknown parameter {key!r}; did you mean {nearest_key(key)!r}?"
            raise ConfigError(msg)
        section, _, name = key.partition(".")
        sections.setdefault(section, {})[name] = checked_value(table[key], value)
    start = Config() if base is None else base
    changed = {
        section: dataclasses.replace(getattr(start, section), **entries)
        for section, entries in sections.items()
    }
    return dataclasses.replace(start, **changed)


def values_from_config(config: Config) -> dict[str, Value]:
    """Flat dotted values of a configuration."""
    flat: dict[str, Value] = {}
    for row in parameters():
        section, _, name = row.name.partition(".")
        flat[row.name] = getattr(getattr(config, section), name)
    return flat


def contradictions(config: Config | SimpleNamespace) -> Iterator[str]:
    """What in the sections does not go together, a line each."""
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
    if lidar.min_range >= lidar.max_range:
        yield (
            f"lidar.min_range = {lidar.min_range} is not below lidar.max_range = {lidar.max_range}"
        )
    mount = config.mount
    if mount.gimbal and mount.tf:
        yield "mount.gimbal and mount.tf: the mount comes from lidar/gimbal or from /tf_static"
    elsewhere = MountConfig(gimbal=mount.gimbal, tf=mount.tf, axes=mount.axes)
    if (mount.gimbal or mount.tf) and mount != elsewhere:
        name, topic = ("gimbal", "lidar/gimbal") if mount.gimbal else ("tf", "/tf_static")
        yield f"mount.{name} takes the mount from {topic}: leave mount.x ... mount.yaw_deg at 0"
    ages = config.diagnostics
    if ages.warn_age > ages.error_age:
        yield (
            f"diagnostics.warn_age = {ages.warn_age} exceeds"
            f" diagnostics.error_age = {ages.error_age}"
        )
    reason = why_too_much(domain.size, 1 << domain.max_level, config.lss)
    if reason is not None:
        yield f"domain.size = {domain.size:g} m, domain.max_level = {domain.max_level}: {reason}"
