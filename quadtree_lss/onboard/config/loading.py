# SPDX-License-Identifier: Apache-2.0
"""Configuration files, in the form of ROS 2 parameter files, to `config.settings.Config` and back.

    /**:
      ros__parameters:
        domain:
          size: 64.0
        lss.grid_spacing: 0.25

The same file serves ``--params-file`` of the nodes and the replay. Several files overlay each
other, the later wins.
"""

from __future__ import annotations

import difflib
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from quadtree_lss.onboard.config.settings import (
    Config,
    ConfigError,
    Parameter,
    checked_values,
    config_from_values,
    flatten,
    parameters,
    values_from_config,
)
from quadtree_lss.onboard.config.yaml_text import MOST_BYTES, YamlError, parse_yaml

NODES = ("mapping_node", "lss_node")
ROS_OWN = re.compile(r"use_sim_time|start_type_description_service|qos_overrides\..*")
"""Parameters that ROS itself declares; they mean nothing offline."""


def load_config(
    paths: Iterable[str | os.PathLike[str]] = (),
    overrides: Mapping[str, object] | None = None,
    *,
    origin: str = "overrides",
) -> Config:
    """The defaults with each file and then ``overrides`` laid over them.

    Args:
        paths: Files, or names of shipped ones (see `find_config`).
        overrides: Dotted or nested values that win over every file.
        origin: Where the overrides come from, for messages.

    Raises:
        ConfigError: names the file, and for an unknown key the nearest known one.
    """
    values: dict[str, object] = {}
    files = []
    for path in paths:
        found = find_config(path)
        read = read_values(found)
        _check(read, str(found))
        values |= read
        files.append(str(found))
    wanted = flatten(overrides or {})
    _check(wanted, origin)
    try:
        return config_from_values(values | wanted)
    except ConfigError as error:  # values that contradict one another
        where = ", ".join(files + [origin] * bool(wanted))
        msg = f"{where}: {error}" if where else str(error)
        raise ConfigError(msg) from None


def _check(values: Mapping[str, object], where: str) -> None:
    """Each key by itself, so that the message can name the file."""
    try:
        checked_values(values)
    except ConfigError as error:
        msg = f"{where}: {error}"
        raise ConfigError(msg) from None


def find_config(path: str | os.PathLike[str]) -> Path:
    """The file itself, else the shipped configuration of that name.

    ``morpheus``, ``morpheus.yaml`` and ``config/morpheus.yaml`` all name the shipped one. Raises
    `ConfigError`: no such file; lists the shipped ones."""
    given = Path(path)
    if given.is_file():
        return given
    name = given.name if given.suffix else f"{given.name}.yaml"
    shipped = list(_shipped())
    if given.parent in (Path("."), Path("config")):
        for candidate in shipped:
            if candidate.name == name:
                return candidate
    names = shipped_names()
    msg = f"no configuration file {str(path)!r} (shipped: {', '.join(names) or 'none'})"
    beside = [p.stem for p in given.parent.glob("*.yaml")] if given.parent.is_dir() else []
    close = difflib.get_close_matches(given.stem, [*names, *beside], n=1)
    if close:
        near = close[0] if close[0] in names else given.with_name(f"{close[0]}.yaml")
        msg += f"; did you mean '{near}'?"
    raise ConfigError(msg)


def shipped_names() -> list[str]:
    """Names of the shipped configurations."""
    return sorted({path.stem for path in _shipped()})


def _shipped() -> Iterator[Path]:
    prefixes = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    places = [Path(p) / "share" / "quadtree_lss" / "config" for p in (sys.prefix, *prefixes)]
    for place in places:
        yield from sorted(place.glob("*.yaml"))


def read_values(path: str | os.PathLike[str], faults: list[str] | None = None) -> dict[str, object]:
    """Dotted values of the sections ``/**`` and of this package's nodes, in the file's order.

    Sections of other nodes are left alone, unless their name looks like a misspelt one of ours.

    Args:
        path: The file.
        faults: Gets what is wrong with single sections, instead of an error.

    Raises:
        ConfigError: not readable, no YAML, not in the form of a parameter file.
    """
    values: dict[str, object] = {}
    sections = 0
    for name, section in _sections(_content(path)):
        try:
            if not _is_ours(name):
                continue
            sections += 1
            values |= flatten(_keys_of(name, section))
        except ConfigError as error:
            if faults is None:
                msg = f"{path}: {error}"
                raise ConfigError(msg) from None
            faults.append(str(error))
    if not sections and not faults:
        msg = f"{path}: no section '/**:' with 'ros__parameters:' (or one of {', '.join(NODES)})"
        raise ConfigError(msg)
    return {key: value for key, value in values.items() if not ROS_OWN.fullmatch(key)}


def check_reaches(path: str | os.PathLike[str], node: str) -> None:
    """See that something in a parameter file is for a node.

    Args:
        path: The file.
        node: Full name, with its namespace.

    Raises:
        ConfigError: not readable, or ROS would give the node nothing of it.
    """
    names = [name for name, _ in _sections(_content(path))]
    # As rcl has it: /** stands for any namespaces, /* for one of them or a name.
    wildcards = {r"/\*\*": r"(/\w+)*", r"/\*": r"/\w+"}
    patterns = [re.escape(name) for name in names]
    for sign, stands_for in wildcards.items():
        patterns = [pattern.replace(sign, stands_for) for pattern in patterns]
    if not any(re.fullmatch(pattern, node) for pattern in patterns):
        found = ", ".join(f"'{name}'" for name in names) or "none"
        msg = f"{path}: no section is for '{node}', which would run on the defaults: it has {found}"
        raise ConfigError(msg)


def _content(path: str | os.PathLike[str]) -> Mapping[Any, Any]:
    try:
        with open(path, encoding="utf-8") as file:
            content = parse_yaml(file.read(MOST_BYTES + 1))
    except (OSError, UnicodeDecodeError) as error:
        msg = f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}"
        raise ConfigError(msg) from None
    except YamlError as error:
        msg = f"{path}: {error}"
        raise ConfigError(msg) from None
    return content if isinstance(content, Mapping) else {}


def _sections(content: Mapping[Any, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Names of nodes, with namespaces, and what stands in their ``ros__parameters``."""
    for key, value in content.items():
        name = f"{prefix}/{str(key).strip('/')}"
        if not isinstance(value, Mapping):
            continue
        if "ros__parameters" in value:
            yield name, value["ros__parameters"]
        rest = {k: v for k, v in value.items() if k != "ros__parameters"}
        yield from _sections(rest, name)


def _is_ours(name: str) -> bool:
    node = name.rsplit("/", 1)[-1]
    if node in (*NODES, "**", "*"):
        return True
    close = difflib.get_close_matches(node, NODES, n=1, cutoff=0.75)
    if close:
        msg = f"unknown section '{node}'; did you mean '{close[0]}'?"
        raise ConfigError(msg)
    return False


def _keys_of(name: str, section: object) -> dict[str, object]:
    if section is not None and not isinstance(section, Mapping):
        msg = f"ros__parameters of '{name}' holds no keys"
        raise ConfigError(msg)
    return _with_text_keys(section or {})


def _with_text_keys(values: Mapping[Any, Any]) -> dict[str, object]:
    return {
        str(key): _with_text_keys(value) if isinstance(value, Mapping) else value
        for key, value in values.items()
    }


def dump_config(config: Config, *, comments: bool = False) -> str:
    """A parameter file that loads to ``config`` again; with ``comments`` each key is explained."""
    told = {row.name: _explanation(row) for row in parameters()} if comments else {}
    return dump_values(values_from_config(config), told)


def dump_values(values: Mapping[str, object], comments: Mapping[str, str]) -> str:
    """A parameter file of dotted values in the order of the table, with comments by key."""
    lines = ["/**:", "  ros__parameters:"]
    section = ""
    for row in parameters():
        if row.name not in values:
            continue
        start, _, name = row.name.partition(".")
        if start != section:
            section = start
            lines.append(f"    {section}:")
        if row.name in comments:
            lines.append(f"      # {comments[row.name]}")
        lines.append(f"      {name}: {scalar_text(values[row.name])}")
    return "\n".join(lines) + "\n"


def scalar_text(value: object) -> str:
    """A value as YAML has it."""
    text: str = yaml.safe_dump(value, default_flow_style=True, width=1000)
    return text.removesuffix("\n").removesuffix("\n...")


def _explanation(row: Parameter) -> str:
    parts = [row.doc]
    if row.unit:
        parts.append(row.unit)
    if row.choices:
        parts.append(" | ".join(row.choices))
    elif row.type in (int, float):
        parts.append(f"{row.low:g} .. {row.high:g}")
    return "; ".join(parts)
