# SPDX-License-Identifier: Apache-2.0
"""YAML from outside, within bounds: what is read takes memory and time by its length alone.

Aliases and merges could make a kilobyte mean gigabytes. ROS's own parser refuses aliases too.
"""

from __future__ import annotations

import os
import re
from typing import Any

import yaml

from quadtree_lss.onboard.errors import QuadtreeLssError

MAX_YAML_BYTES = 1 << 20
"""Of a text; a configuration of all parameters, explained, has 20,000."""


class YamlError(QuadtreeLssError):
    """The text is no YAML, or more than is read."""


class _Loader(yaml.SafeLoader):
    """YAML as ROS reads it: 1e-3 is a number. A key that stands twice, or merges, is an error."""

    aliases = False

    def compose_node(self, parent: Any, index: Any) -> Any:
        """As in the base class, refusing aliases."""
        if not self.aliases and self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            self._refuse("aliases (*name) are not read", mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """As in the base class, refusing repeated keys."""
        seen: set[object] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if key in seen:
                self._refuse(f"key {key!r} stands twice", key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)

    def _refuse(self, problem: str, mark: Any) -> None:
        raise yaml.MarkedYAMLError(problem=problem, problem_mark=mark)


class _WithAliases(_Loader):
    aliases = True


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)
_WithAliases.yaml_implicit_resolvers = _Loader.yaml_implicit_resolvers


def read_yaml(path: str | os.PathLike[str]) -> object:
    """What stands in a file. Raises `YamlError`: as of `parse_yaml`, or it cannot be read."""
    try:
        with open(path, encoding="utf-8") as file:
            return parse_yaml(file.read(MAX_YAML_BYTES + 1))
    except (OSError, UnicodeDecodeError) as error:
        msg = f"cannot be read: {getattr(error, 'strerror', None) or error}"
        raise YamlError(msg) from None


def parse_yaml(text: str, *, aliases: bool = False) -> object:
    """What stands in a text of one document; ``aliases`` are read for a caller who follows few of
    them. Raises `YamlError`: it cannot be understood, or is too long or too deep."""
    if len(text) > MAX_YAML_BYTES:
        msg = f"{len(text)} characters of YAML; {MAX_YAML_BYTES} is the most"
        raise YamlError(msg)
    try:
        return yaml.load(text, Loader=_WithAliases if aliases else _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" in line {mark.line + 1}" if mark else ""
        msg = f"not valid YAML{line}: {getattr(error, 'problem', None) or error}"
        raise YamlError(msg) from None
    except RecursionError:
        msg = "not valid YAML: nested too deeply"
        raise YamlError(msg) from None
    except Exception as error:  # PyYAML's of values: dates, numbers, keys that cannot be keys
        msg = f"not valid YAML: {error}"
        raise YamlError(msg) from None
