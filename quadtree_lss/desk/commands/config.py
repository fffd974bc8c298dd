# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss config``: print, check, explain."""

from __future__ import annotations

import argparse

from quadtree_lss.desk.commands import common, explained
from quadtree_lss.desk.commands.console import ProgressBar, warn
from quadtree_lss.desk.replay.configuration import dump_config, load_config, slow
from quadtree_lss.onboard.config.risk import doubt
from quadtree_lss.onboard.config.settings import config_from_values, values_from_config

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

ACTION is print (the default), check, explain or suggest.
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = common.add_command(commands, "config", _run, TEXT, EXAMPLES)
    add = parser.add_argument
    add("action", nargs="?", choices=ACTIONS, default="print", metavar="ACTION")
    text = "files to check; keys or sections to explain; the bag to suggest for"
    add("names", nargs="*", metavar="NAME", help=text)
    common.add_config_options(parser)
    add("--poses", type=common.named, metavar="FILE", help=common.POSES)
    text = "check: the files are for this node, /uav1/lss_node"
    add("--node", default="", metavar="NAME", help=text)
    text = "suggest for a vehicle of this diameter and clearance, m"
    add("--vehicle", type=vehicle, metavar="D,C", help=text)


def vehicle(text: str) -> dict[str, float]:
    """``0.6,0.08`` as values of the vehicle."""
    try:
        diameter, clearance = (float(part) for part in text.split(","))
    except ValueError:
        msg = f"'{text}' is not a diameter and a clearance D,C in m"
        raise argparse.ArgumentTypeError(msg) from None
    return {"vehicle.diameter": diameter, "vehicle.clearance": clearance}


def _run(options: argparse.Namespace) -> int:
    if options.action != "print" and not options.names:
        options.parser.error(f"config {options.action}: name at least one")
    return ACTIONS[options.action](options)


def _explain(options: argparse.Namespace) -> int:
    rows = [row for name in options.names for row in explained.explain(name)]
    texts = [explained.explain_text(row) for row in rows]
    if any(row.name.startswith("vehicle.") for row in rows):
        texts.append(explained.lengths_text(common.chosen_config(options).vehicle))
    told = {row.name: explained.parameter_as_dict(row) for row in rows}
    common.show(options, told, "\n\n".join(texts))
    return common.DONE


def _print(options: argparse.Namespace) -> int:
    if options.names:
        options.parser.error(f"config print takes no names, got {' '.join(options.names)}")
    config = common.chosen_config(options)
    text = dump_config(config, comments=True)
    common.show(options, values_from_config(config), text.removesuffix("\n"))
    return common.DONE


def _check(options: argparse.Namespace) -> int:
    found = explained.check_files(options.names, options.node)
    lines = (f"{name}: {line}" for name, errors in found.items() for line in errors or ["good"])
    common.show(options, found, "\n".join(lines))
    for name in (name for name, errors in found.items() if not errors and not options.json):
        config = load_config([name])
        for said in filter(None, (doubt(config), slow(config))):
            warn(f"{name}: {said}")
    return common.ERROR if any(found.values()) else common.DONE


def _suggest(options: argparse.Namespace) -> int:
    from quadtree_lss.desk.replay.suggest import suggest_config

    if len(options.names) != 1:
        options.parser.error("config suggest takes one bag")
    config = config_from_values(options.vehicle or {}, common.chosen_config(options))
    with ProgressBar("suggest", "s", options.verbose) as bar:
        found = suggest_config(options.names[0], config, poses=options.poses, progress=bar.update)
    common.show(options, found.as_dict(), found.text().removesuffix("\n"))
    for note in found.notes[1:]:
        warn(note)
    return common.DONE


ACTIONS = {"print": _print, "check": _check, "explain": _explain, "suggest": _suggest}
