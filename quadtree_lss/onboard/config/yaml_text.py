# SPDX-License-Identifier: Apache-2.0
"""YAML of limited length without aliases, so that memory and time depend only on the length.

Aliases and merges can expand a kilobyte to gigabytes. ROS's own parser rejects aliases too.
"""

from __future__ import annotations

import os
import re
from typing import Any

import yaml

from quadtree_lss.onboard.errors import QuadtreeLssError

MAX_YAML_BYTES = 1 << 20
"""Largest size of a text; a commented configuration of all parameters has 20,000 bytes."""


class YamlError(QuadtreeLssError):
    """The text is not valid YAML, or too long."""


class _Loader(yaml.SafeLoader):
    """Loader that reads 1e-3 as a number, as ROS does, and rejects repeated keys and merges."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose a node as in the base class; reject aliases."""
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            self._reject("aliases (*name) are not read", mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping as in the base class; reject repeated keys."""
        seen: set[object] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if key in seen:
                self._reject(f"key {key!r} appears twice", key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)

    def _reject(self, problem: str, mark: Any) -> None:
        raise yaml.MarkedYAMLError(problem=problem, problem_mark=mark)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


def read_yaml(path: str | os.PathLike[str]) -> object:
    """Parse a file. Raises `YamlError` as `parse_yaml`, or if the file cannot be read."""
    try:
        with open(path, encoding="utf-8") as file:
            return parse_yaml(file.read(MAX_YAML_BYTES + 1))
    except (OSError, UnicodeDecodeError) as error:
        raise YamlError(f"cannot be read: {getattr(error, 'strerror', None) or error}") from None


def parse_yaml(text: str, loader: type[yaml.SafeLoader] = _Loader) -> object:
    """Parse a text of one document. Raises `YamlError` if it is not valid YAML, too long or nested
    too deeply."""
    if len(text) > MAX_YAML_BYTES:
        raise YamlError(f"{len(text)} characters of YAML; {MAX_YAML_BYTES} is the most")
    try:
        return yaml.load(text, Loader=loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" in line {mark.line + 1}" if mark else ""
        msg = f"not valid YAML{line}: {getattr(error, 'problem', None) or error}"
        raise YamlError(msg) from None
    except RecursionError:
        raise YamlError("not valid YAML: nested too deeply") from None
    except Exception as error:  # PyYAML raises various errors for dates, numbers and keys
        raise YamlError(f"not valid YAML: {error}") from None
