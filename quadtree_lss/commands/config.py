# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss config``: print, check, explain."""

from __future__ import annotations

import argparse

from quadtree_lss.commands.common import (
    DONE,
    ERROR,
    add_command,
    add_config_options,
    add_json,
    chosen_config,
    print_json,
)
from quadtree_lss.config.loading import (
    check_files,
    dump_config,
    explain,
    explain_text,
    parameter_as_dict,
)
from quadtree_lss.config.settings import values_from_config

TEXT = "Print a configuration as a ROS parameter file, check files, explain parameters."
EXAMPLES = """examples:
  quadtree-lss config > my_lander.yaml                  (every parameter, explained)
  quadtree-lss config --config morpheus --set lss.margin=1.0
  quadtree-lss config check my_lander.yaml other.yaml   (exit code 1 if one is wrong)
  quadtree-lss config explain lss.margin                (one parameter)
  quadtree-lss config explain lss                       (a section)
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declares the subcommand."""
    parser = add_command(commands, "config", _run, TEXT, EXAMPLES)
    add = parser.add_argument
    add("action", nargs="?", choices=("print", "check", "explain"), default="print")
    add("names", nargs="*", metavar="NAME", help="files to check; keys or sections to explain")
    add_config_options(parser)
    add("--plain", action="store_true", help="print without the explanations")
    add_json(parser)


def _run(options: argparse.Namespace) -> int:
    if options.action == "print":
        return _print(options)
    if not options.names:
        options.parser.error(f"config {options.action}: name at least one")
    if options.action == "check":
        return _check(options)
    rows = [row for name in options.names for row in explain(name)]
    if options.json:
        print_json({row.name: parameter_as_dict(row) for row in rows})
    else:
        print("\n\n".join(explain_text(row) for row in rows))
    return DONE


def _print(options: argparse.Namespace) -> int:
    if options.names:
        options.parser.error(f"config print takes no names, got {' '.join(options.names)}")
    config = chosen_config(options)
    if options.json:
        print_json(values_from_config(config))
    else:
        print(dump_config(config, comments=not options.plain), end="")
    return DONE


def _check(options: argparse.Namespace) -> int:
    found = check_files(options.names)
    if options.json:
        print_json(found)
    else:
        for name, error in found.items():
            print(f"{name}: {'good' if error is None else error}")
    return DONE if all(error is None for error in found.values()) else ERROR
