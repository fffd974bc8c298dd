# SPDX-License-Identifier: Apache-2.0
"""Substitute for the part of `launch` and `launch_ros` that the launch file uses.

ROS's wheels have neither. Classes only store their arguments; `built` does what the launch
service does with a description: declare arguments, run opaque functions, collect what they return.
"""

import runpy
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from installed import PREFIX


class Record:
    """Entity that stores positional arguments in ``args`` and others as attributes."""

    def __init__(self, *args: Any, **named: Any) -> None:
        self.args = args
        self.__dict__.update(named)


class Context:
    """Values of launch arguments."""

    def __init__(self, values: Mapping[str, str]) -> None:
        self.launch_configurations = dict(values)
        self.is_shutdown = False


class LaunchConfiguration(Record):
    """Return the value of an argument; an undeclared one is an error, as in launch."""

    def perform(self, context: Context) -> str:
        return context.launch_configurations[self.args[0]]


class FindPackageShare(Record):
    """The share folder of an installed package."""

    def perform(self, context: Context) -> str:
        return str(PREFIX / "share" / self.args[0])


def kept(*names: str) -> dict[str, Any]:
    """Make classes of these names that only store their arguments."""
    return {name: type(name, (Record,), {}) for name in names}


MODULES: dict[str, dict[str, Any]] = {
    "launch": {
        "LaunchContext": Context,
        "LaunchDescriptionEntity": Record,
        **kept("LaunchDescription"),
    },
    "launch.actions": kept(
        "DeclareLaunchArgument", "EmitEvent", "LogInfo", "OpaqueFunction", "RegisterEventHandler"
    ),
    "launch.event_handlers": kept("OnProcessExit"),
    "launch.events.process": kept("ProcessExited", "ShutdownProcess"),
    "launch.substitutions": {"LaunchConfiguration": LaunchConfiguration},
    "launch_ros": {},
    "launch_ros.actions": kept("Node"),
    "launch_ros.substitutions": {"FindPackageShare": FindPackageShare},
}
(DeclareLaunchArgument, EmitEvent, _, OpaqueFunction, RegisterEventHandler) = MODULES[
    "launch.actions"
].values()
Node = MODULES["launch_ros.actions"]["Node"]
ShutdownProcess = MODULES["launch.events.process"]["ShutdownProcess"]


def built(path: Path, monkeypatch: Any, **given: str) -> tuple[list[Any], Context]:
    """Return the entities of a launch file in order, and the context."""
    for name, content in MODULES.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    description = runpy.run_path(str(path))["generate_launch_description"]()
    context = Context({})
    entities: list[Any] = []
    for entity in description.args[0]:
        if isinstance(entity, DeclareLaunchArgument):
            (name,), value = entity.args, entity.default_value
            default = value if isinstance(value, str) else value.perform(context)
            context.launch_configurations[name] = given.pop(name, default)
        elif isinstance(entity, OpaqueFunction):
            entities += entity.function(context)
        else:
            entities.append(entity)
    assert not given, f"no such arguments: {sorted(given)}"
    return entities, context
