# SPDX-License-Identifier: Apache-2.0
"""Configuration files, which are ROS 2 parameter files:

    /**:
      ros__parameters:
        domain:
          size: 64.0
        lss.grid_spacing: 0.25

Nodes (``--params-file``) and replay read the same files. A later file overrides an earlier one.
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterator, Mapping
from typing import Any

from quadtree_lss.onboard.config.settings import ConfigError, flatten
from quadtree_lss.onboard.config.yaml_text import YamlError, read_yaml

NODES = ("mapping_node", "lss_node", "autopilot_node")
ROS_OWN = re.compile(r"use_sim_time|start_type_description_service|qos_overrides\..*")
"""Parameters that ROS itself declares; they have no effect offline."""


def read_values(path: str | os.PathLike[str], faults: list[str] | None = None) -> dict[str, object]:
    """Read the values of ``/**`` and of this package's nodes by dotted name, in the file's order.

    Sections of other nodes are ignored, except for misspelt names of this package's nodes.

    Args:
        path: Parameter file.
        faults: Receives the errors of single sections, which are otherwise raised.

    Raises:
        ConfigError: The file is not readable, not YAML or not a parameter file.
    """
    values: dict[str, object] = {}
    sections = 0
    for name, section in _sections(path):
        try:
            if not _is_ours(name):
                continue
            sections += 1
            if not isinstance(section or {}, Mapping):
                raise ConfigError(f"ros__parameters of '{name}' has no keys")
            values |= flatten(section or {})
        except ConfigError as error:
            if faults is None:
                raise ConfigError(f"{path}: {error}") from None
            faults.append(str(error))
    if not sections and not faults:
        msg = f"{path}: no section '/**:' with 'ros__parameters:' (or one of {', '.join(NODES)})"
        raise ConfigError(msg)
    return {key: value for key, value in values.items() if not ROS_OWN.fullmatch(key)}


def check_reaches(path: str | os.PathLike[str], node: str) -> None:
    """Check that a parameter file has a section for a node, by its full name. Raises `ConfigError`
    if it has none or is not readable."""
    names = [name for name, _ in _sections(path)]
    # As in rcl: /** matches any namespaces, /* one namespace or a name.
    patterns = [
        re.escape(name).replace(r"/\*\*", r"(/\w+)*").replace(r"/\*", r"/\w+") for name in names
    ]
    if not any(re.fullmatch(pattern, node) for pattern in patterns):
        found = ", ".join(f"'{name}'" for name in names) or "none"
        msg = f"{path}: no section is for '{node}', which would run on the defaults: it has {found}"
        raise ConfigError(msg)


def _sections(path: str | os.PathLike[str]) -> Iterator[tuple[str, Any]]:
    """Yield the names of nodes, with namespaces, and the content of their ``ros__parameters``."""
    try:
        yield from _nested_sections(read_yaml(path), "")
    except YamlError as error:
        raise ConfigError(f"{path}: {error}") from None


def _nested_sections(content: object, name: str) -> Iterator[tuple[str, Any]]:
    if isinstance(content, Mapping):
        if name and "ros__parameters" in content:
            yield name, content["ros__parameters"]
        for key, value in content.items():
            if key != "ros__parameters":
                yield from _nested_sections(value, f"{name}/{str(key).strip('/')}")


def _is_ours(name: str) -> bool:
    node = name.rsplit("/", 1)[-1]
    if node in (*NODES, "**", "*"):
        return True
    close = difflib.get_close_matches(node, NODES, n=1, cutoff=0.75)
    if close:
        raise ConfigError(f"unknown section '{node}'; did you mean '{close[0]}'?")
    return False
