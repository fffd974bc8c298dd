# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss config``: print, check, explain and suggest configurations."""

from __future__ import annotations

import argparse
import dataclasses
import os
from types import SimpleNamespace

from quadtree_lss.desk.commands import common
from quadtree_lss.desk.commands.console import progress_bar, warn
from quadtree_lss.desk.replay import configuration
from quadtree_lss.desk.replay.files import plain
from quadtree_lss.onboard.config import settings
from quadtree_lss.onboard.config.loading import check_reaches, read_values
from quadtree_lss.onboard.config.risk import model_warning
from quadtree_lss.onboard.config.settings import Config, ConfigError, Parameter
from quadtree_lss.onboard.config.vehicle import Lengths, VehicleConfig

TEXT = (
    "Print a configuration as a ROS parameter file, check files, explain parameters, or suggest"
    " domain, noise and cells for a bag."
)
EXAMPLES = """examples:
  quadtree-lss config > my_lander.yaml                  (every parameter, explained)
  quadtree-lss config --config morpheus --set lss.margin=1.0
  quadtree-lss config check my_lander.yaml other.yaml   (all errors; exit code 1 if there is one)
  quadtree-lss config check my_lander.yaml --node /uav1/lss_node    (does it reach this node?)
  quadtree-lss config explain lss.margin                (one parameter)
  quadtree-lss config explain lss                       (a section)
  quadtree-lss config explain vehicle --config drone    (and the lengths that follow from it)
  quadtree-lss config suggest flight_bag > flight.yaml  (domain, noise, cell sizes from its data)
  quadtree-lss config suggest bag --vehicle 0.6,0.08    (for a drone that clears 8 cm)

Without an ACTION the configuration is printed.
"""


CHECK = "Check parameter files: all errors of each; exit code 1 if there is one."
EXPLAIN = "Explain parameters or whole sections, and the lengths that follow from the vehicle."
SUGGEST = "Suggest domain, noise and cell sizes for a bag, as a parameter file."


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = common.add_command(commands, "config", _print, TEXT, EXAMPLES)
    shipped = {name: f"config --config {name}" for name in configuration.shipped_configs()}
    parser.suggestions = {**shipped, "print": "config without an action"}
    common.add_config_options(parser)
    actions = parser.add_subparsers(metavar="ACTION", help="check, explain or suggest")
    check = common.add_command(actions, "check", _check, CHECK, EXAMPLES)
    check.add_argument("names", nargs="+", metavar="FILE", help="files to check")
    text = "check that the files are for this node, /uav1/lss_node"
    check.add_argument("--node", default="", metavar="NAME", help=text)
    explain = common.add_command(actions, "explain", _explain, EXPLAIN, EXAMPLES)
    explain.add_argument("names", nargs="+", metavar="NAME", help="keys or sections")
    common.add_config_options(explain)
    suggest = common.add_command(actions, "suggest", _suggest, SUGGEST, EXAMPLES)
    suggest.add_argument("bag", type=common.path, metavar="BAG", help=common.BAG)
    common.add_topics(suggest)
    common.add_config_options(suggest)
    for command in (check, explain, suggest):  # keep options before the action
        for option in command._actions:
            if option.dest in ("quiet", "verbose", "json", "config", "set", "vehicle"):
                option.default = argparse.SUPPRESS


def _explain(options: argparse.Namespace) -> int:
    rows = [row for name in options.names for row in explain(name)]
    texts = [explain_text(row) for row in rows]
    if any(row.name.startswith("vehicle.") for row in rows):
        texts.append(lengths_text(common.chosen_config(options).vehicle))
    content = {row.name: plain({**vars(row), "type": row.type.__name__}) for row in rows}
    common.show(options, content, "\n\n".join(texts))
    return common.DONE


def _print(options: argparse.Namespace) -> int:
    config = common.chosen_config(options)
    text = configuration.dump_config(config, comments=True)
    common.show(options, settings.values_from_config(config), text.removesuffix("\n"))
    return common.DONE


def _check(options: argparse.Namespace) -> int:
    found = {name: file_errors(name, options.node) for name in options.names}
    lines = (f"{name}: {line}" for name, errors in found.items() for line in errors or ["good"])
    common.show(options, found, "\n".join(lines))
    for name in (name for name, errors in found.items() if not errors and not options.json):
        config = configuration.load_config([name])
        if warning := model_warning(config):
            warn(f"{name}: {warning}")
    return common.ERROR if any(found.values()) else common.DONE


def _suggest(options: argparse.Namespace) -> int:
    from quadtree_lss.desk.replay.info import inspect_bag
    from quadtree_lss.desk.replay.suggest import suggest_config

    config, arguments = common.chosen_config(options), common.keywords(options, *common.TOPICS)
    with progress_bar("suggest", "s", options.verbose) as update:
        info = inspect_bag(options.bag, config, **arguments, diagnose=True, progress=update)
        # Without a suggestion this raises the reason.
        found = info.suggestion or suggest_config(options.bag, config, **arguments)
    # The suggested domain fixes "outside".
    faults = [finding for finding in info.findings if finding.fix and finding.key != "outside"]
    notes = [f"Fault: {finding.line}" for finding in faults]
    found = dataclasses.replace(found, notes=(*found.notes, *notes))
    common.show(options, found.as_dict(), found.text().removesuffix("\n"))
    for note in found.notes[1:]:
        warn(note)
    return common.DONE


def file_errors(path: str | os.PathLike[str], node: str = "") -> list[str]:
    """Return all errors of a file. ``node``: full name of a node for which it must have
    parameters."""
    errors: list[str] = []
    try:
        found = configuration.find_config(path)
        if node:
            check_reaches(found, node)
        values = read_values(found, errors)
    except ConfigError as error:
        return [str(error).removeprefix(f"{path}: ")]
    valid = settings.checked_values(values, errors)
    sections = {
        item.name: dataclasses.replace(getattr(Config(), item.name), **valid.get(item.name, {}))
        for item in dataclasses.fields(Config)
    }
    sections["lss"] = dataclasses.replace(sections["lss"], vehicle=sections["vehicle"])
    return errors + list(settings.contradictions(SimpleNamespace(**sections)))


def explain(name: str) -> list[Parameter]:
    """Return the parameter of a name, or all of a section. Raises `ConfigError`, which names the
    most similar one, if there is none."""
    table = settings.parameters()
    rows = [row for row in table if row.name == name or row.name.startswith(f"{name}.")]
    if not rows:
        sections = sorted({row.name.partition(".")[0] for row in table})
        raise ConfigError(f"{settings.unknown_parameter(name)} (sections: {', '.join(sections)})")
    return rows


def explain_text(row: Parameter) -> str:
    unit = f" {row.unit}" if row.unit else ""
    lines = [f"{row.name} ({row.type.__name__})", f"  {row.doc}"]
    lines.append(f"  default  {configuration.scalar_text(row.default)}{unit}")
    name = row.name.removeprefix("lss.")
    if name in Lengths.__dataclass_fields__:
        lines[-1] += f": {rule(name)}, {getattr(Lengths(), name):g}{unit} of the default vehicle"
    if row.choices:
        lines.append(f"  choices  {', '.join(row.choices)}")
    elif row.type in (int, float):
        lines.append(f"  range    {row.low:g} .. {row.high:g}{unit}")
    lines.append(f"  running  {'may be set on a running node' if row.live else 'read at start'}")
    return "\n".join(lines)


def lengths_text(vehicle: VehicleConfig) -> str:
    """List the lengths derived from a vehicle, with value and rule, a line each."""
    of = f"{vehicle.diameter:g} m with a clearance of {vehicle.clearance:g} m"
    lines = [f"values derived from a vehicle of {of}:"]
    for item in dataclasses.fields(Lengths):
        value = f"{getattr(vehicle.lengths, item.name):.4g} {item.metadata['unit']}"
        text = f"{rule(item.name)}: {item.metadata['doc']}"
        lines.append(f"  {item.name:<20} {value:<12} = {text}")
    return "\n".join(lines)


def rule(name: str) -> str:
    """Format the rule of a length: ``0.833 x vehicle.clearance``, ``0.5 x least_hazard``."""
    item = Lengths.__dataclass_fields__[name]
    if item.metadata["rule"]:
        return str(item.metadata["rule"])
    base, power = item.metadata["of"], item.metadata["power"]
    factor = item.default / getattr(VehicleConfig(), base) ** power
    name = base if base in Lengths.__dataclass_fields__ else f"vehicle.{base}"
    return f"{factor:.3g} x {name}" + (f"^{power}" if power > 1 else "")
