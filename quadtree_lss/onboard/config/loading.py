# SPDX-License-Identifier: Apache-2.0
"""Configuration files, in the form of ROS 2 parameter files: what they say to which node.

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
from collections.abc import Iterator, Mapping
from typing import Any

from quadtree_lss.onboard.config.settings import ConfigError, flatten
from quadtree_lss.onboard.config.yaml_text import YamlError, read_yaml

NODES = ("mapping_node", "lss_node", "autopilot_node")
ROS_OWN = re.compile(r"use_sim_time|start_type_description_service|qos_overrides\..*")
"""Parameters that ROS itself declares; they mean nothing offline."""


def read_values(path: str | os.PathLike[str], faults: list[str] | None = None) -> dict[str, object]:
    """Dotted values of the sections ``/**`` and of this package's nodes, in the file's order.

    Sections of other nodes are left alone, unless their name looks like a misspelt one of ours.
    ``faults`` gets what is wrong with single sections, instead of an error. Raises `ConfigError`:
    not readable, no YAML, not in the form of a parameter file.
    """
    values: dict[str, object] = {}
    sections = 0
    for name, section in _sections(_content(path)):
        try:
            if not _is_ours(name):
                continue
            sections += 1
            if not isinstance(section or {}, Mapping):
                msg = f"ros__parameters of '{name}' holds no keys"
                raise ConfigError(msg)
            values |= flatten(section or {})
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
    """See that something in a parameter file is for a node, by its full name. Raises `ConfigError`:
    not readable, or ROS would give the node nothing of it."""
    names = [name for name, _ in _sections(_content(path))]
    # As rcl has it: /** stands for any namespaces, /* for one of them or a name.
    patterns = [
        re.escape(name).replace(r"/\*\*", r"(/\w+)*").replace(r"/\*", r"/\w+") for name in names
    ]
    if not any(re.fullmatch(pattern, node) for pattern in patterns):
        found = ", ".join(f"'{name}'" for name in names) or "none"
        msg = f"{path}: no section is for '{node}', which would run on the defaults: it has {found}"
        raise ConfigError(msg)


def _content(path: str | os.PathLike[str]) -> Mapping[Any, Any]:
    try:
        content = read_yaml(path)
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
