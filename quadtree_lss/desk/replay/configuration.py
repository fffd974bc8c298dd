# SPDX-License-Identifier: Apache-2.0
"""Loading of configurations from files and shipped ones by name, and writing of files."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path

import yaml

from quadtree_lss.onboard.config import settings
from quadtree_lss.onboard.config.loading import read_values
from quadtree_lss.onboard.config.settings import Config, ConfigError, Parameter


def load_config(
    paths: Iterable[str | os.PathLike[str]] = (),
    overrides: Mapping[str, object] | None = None,
    *,
    origin: str = "overrides",
) -> Config:
    """Load files or shipped configurations (`find_config`) over the defaults, then dotted or nested
    ``overrides``. Raises `ConfigError`, which names the file, or the ``origin`` of the overrides,
    and for an unknown key the most similar one."""
    values: dict[str, object] = {}
    files = []
    for path in paths:
        found = find_config(path)
        read = read_values(found)
        with _errors_of(str(found)):
            settings.checked_values(read)
        values |= read
        files.append(str(found))
    flat = settings.flatten(overrides or {})
    with _errors_of(origin):
        settings.checked_values(flat)
    with _errors_of(", ".join(files + [origin] * bool(flat))):  # combinations
        return settings.config_from_values(values | flat)


@contextmanager
def _errors_of(where: str) -> Iterator[None]:
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def find_config(path: str | os.PathLike[str]) -> Path:
    """Return the file itself, else the shipped configuration of that name.

    ``morpheus``, ``morpheus.yaml`` and ``config/morpheus.yaml`` all name the shipped one. Raises
    `ConfigError`, which lists the shipped ones: no such file."""
    given = Path(path)
    if given.is_file():
        return given
    shipped = shipped_configs()
    if given.parent in (Path("."), Path("config")) and given.name.removesuffix(".yaml") in shipped:
        return shipped[given.name.removesuffix(".yaml")]
    near = get_close_matches(given.stem, shipped, 1)
    names = f"did you mean {near[0]}?" if near else f"shipped: {', '.join(shipped) or 'none'}"
    raise ConfigError(f"no configuration file {str(path)!r} ({names})")


def shipped_configs() -> dict[str, Path]:
    """Return the shipped configurations by name, in alphabetical order."""
    prefixes = filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))
    folders = (Path(p, "share/quadtree_lss/config") for p in (*prefixes, sys.prefix))
    return {file.stem: file for folder in folders for file in sorted(folder.glob("*.yaml"))}


def dump_config(config: Config, *, comments: bool = False) -> str:
    """Format a parameter file of ``config``; ``comments``: explain each key."""
    texts = {row.name: _explanation(row) for row in settings.parameters()} if comments else {}
    return dump_values(settings.values_from_config(config), texts)


def dump_values(values: Mapping[str, object], comments: Mapping[str, str]) -> str:
    """Format a parameter file of dotted values in the order of the table, with comments by key."""
    lines = ["/**:", "  ros__parameters:"]
    section = ""
    for row in settings.parameters():
        if row.name not in values:
            continue
        row_section, _, name = row.name.partition(".")
        if row_section != section:
            section = row_section
            lines.append(f"    {section}:")
        if row.name in comments:
            lines.append(f"      # {comments[row.name]}")
        lines.append(f"      {name}: {scalar_text(values[row.name])}")
    return "\n".join(lines) + "\n"


def scalar_text(value: object) -> str:
    text: str = yaml.safe_dump(value, default_flow_style=True, width=1000)
    return text.removesuffix("\n").removesuffix("\n...")


def _explanation(row: Parameter) -> str:
    values = " | ".join(row.choices)
    if not row.choices and row.type in (int, float):
        values = f"{row.low:g} .. {row.high:g}"
    return "; ".join(filter(None, (row.doc, row.unit, values)))
