# SPDX-License-Identifier: Apache-2.0
"""Command line ``quadtree-lss``: a shell around functions that can be imported as well.

Exit codes: 0 done, 1 error, 2 usage, 3 done in part (damaged input), 130 interrupted.
"""

from __future__ import annotations

import argparse
import io
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress

import quadtree_lss
from quadtree_lss import build
from quadtree_lss.desk.commands import config, info, replay, results
from quadtree_lss.desk.commands.common import (
    DONE,
    ERROR,
    EXIT_CODES,
    INTERRUPTED,
    USAGE,
    Parser,
    UsageError,
    print_json,
)
from quadtree_lss.desk.commands.console import first_line, quiet, say
from quadtree_lss.lab.commands import campaign, evaluate, fly
from quadtree_lss.onboard.errors import OutsideInput, QuadtreeLssError

# No part of ROS, and not in every Ubuntu: the nodes do without.
OF_BAGS = ("rosbags", "backports", "lz4", "apsw", "ruamel")
DESK = (replay, results, info, config)
LAB = (fly, evaluate, campaign)
REMEDY = "pip install --user --break-system-packages 'rosbags>=0.11.9'"


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; the answer is the exit code."""
    arguments = without_ros_arguments(sys.argv[1:] if argv is None else argv)
    options = argparse.Namespace()
    for name in ("stdout", "stderr"):  # closed, as by `>&-`
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))
    if isinstance(sys.stdout, io.TextIOWrapper):  # names of files may be no text of the terminal's
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        options, unknown = _parser().parse_known_args(arguments)
        if unknown:
            options.parser.unknown(unknown)
        run: Callable[[argparse.Namespace], int] = options.run
        with quiet(getattr(options, "quiet", False), getattr(options, "json", False)):
            code = run(options)
            sys.stdout.flush()
        return code
    except SystemExit as stop:  # argparse: help, version
        return stop.code if isinstance(stop.code, int) else USAGE
    except BrokenPipeError:  # the reader of our output has gone, as with `| head`
        _print_no_more()
        return DONE
    except KeyboardInterrupt:
        say("interrupted")
        return INTERRUPTED
    except Exception as error:
        code, text = _told(error)
        if text.startswith("internal") and getattr(options, "verbose", False):
            raise
        say(text)
        try:
            if "--json" in arguments:
                print_json({"error": text.partition(": ")[2], "exit_code": code})
            sys.stdout.flush()
        except OSError:  # which the error may be
            _print_no_more()
        return code


def _print_no_more() -> None:
    """What is not written yet is lost; else Python would try again at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _told(error: Exception) -> tuple[int, str]:
    """Exit code and line of an error."""
    if isinstance(error, QuadtreeLssError):
        usage = isinstance(error, (UsageError, OutsideInput))
        return USAGE if usage else ERROR, f"error: {error}"
    if isinstance(error, (OSError, MemoryError)):
        return ERROR, f"error: {first_line(error)}"
    lacks = str(getattr(error, "name", "")).partition(".")[0]
    if isinstance(error, ModuleNotFoundError) and lacks in OF_BAGS:
        return ERROR, f"error: '{error.name}' is not installed, which bags need: {REMEDY}"
    name = type(error).__name__
    return ERROR, f"internal error: {name}: {first_line(error)} (-v shows where)"


def without_ros_arguments(arguments: Sequence[str]) -> list[str]:
    """Arguments without ``--ros-args … [--]``, which launch files add for nodes."""
    kept, ours = [], True
    for argument in arguments:
        if argument == "--ros-args":
            ours = False
        elif ours:
            kept.append(argument)
        elif argument == "--":
            ours = True
    return kept


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="quadtree-lss",
        description="Terrain map of planar elements and ranked landing sites from a flash lidar.",
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    version = f"quadtree_lss {quadtree_lss.__version__} ({build.name()})"
    parser.add_argument("--version", action="version", version=version)
    parser.meant = {"help": "quadtree-lss --help, or COMMAND --help"}
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in (*DESK, *LAB):
        command.add(commands)
    with suppress(ImportError):  # completes words in shells, where it is installed
        import argcomplete

        argcomplete.autocomplete(parser)
    return parser


if __name__ == "__main__":
    sys.exit(main())
