# SPDX-License-Identifier: Apache-2.0
"""Command line ``quadtree-lss``: each subcommand calls a function that can also be imported.

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
from quadtree_lss.desk.commands import config, replay, results
from quadtree_lss.desk.commands.common import (
    DONE,
    ERROR,
    EXIT_CODES,
    INTERRUPTED,
    USAGE,
    Parser,
    UsageError,
    json_text,
)
from quadtree_lss.desk.commands.console import first_line, quiet, say
from quadtree_lss.lab.commands import evaluate, fly
from quadtree_lss.onboard.errors import OutsideInput, QuadtreeLssError

# Modules that only bags need: they are not part of ROS, and not every Ubuntu has them.
BAG_MODULES = ("rosbags", "backports", "lz4", "apsw", "ruamel")
DESK = (replay, results, config)
LAB = (fly, evaluate)
FIX = "pip install --user --break-system-packages 'rosbags>=0.11.9'"


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code."""
    arguments = without_ros_arguments(sys.argv[1:] if argv is None else argv)
    options = argparse.Namespace()
    for name in ("stdout", "stderr"):  # closed, as by `>&-`
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))
    if isinstance(sys.stdout, io.TextIOWrapper):  # file names can be undecodable
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
    except BrokenPipeError:  # the reader has closed the pipe, as with `| head`
        _discard_output()
        return DONE
    except KeyboardInterrupt:
        say("interrupted")
        return INTERRUPTED
    except Exception as error:
        code, text = _error_text(error)
        if text.startswith("internal") and getattr(options, "verbose", False):
            raise
        say(text)
        try:
            if "--json" in arguments:
                print(json_text({"error": text.partition(": ")[2], "exit_code": code}))
            sys.stdout.flush()
        except OSError:  # possibly the same error
            _discard_output()
        return code


def _discard_output() -> None:
    """Discard unwritten output, which Python would otherwise flush at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _error_text(error: Exception) -> tuple[int, str]:
    """Return exit code and message of an error."""
    if isinstance(error, QuadtreeLssError):
        usage = isinstance(error, (UsageError, OutsideInput))
        return USAGE if usage else ERROR, f"error: {error}"
    if isinstance(error, (OSError, MemoryError)):
        return ERROR, f"error: {first_line(error)}"
    module = str(getattr(error, "name", "")).partition(".")[0]
    if isinstance(error, ModuleNotFoundError) and module in BAG_MODULES:
        return ERROR, f"error: bags need '{error.name}', which is not installed: {FIX}"
    name = type(error).__name__
    return ERROR, f"internal error: {name}: {first_line(error)} (-v shows where)"


def without_ros_arguments(arguments: Sequence[str]) -> list[str]:
    """Remove ``--ros-args … [--]``, which launch files add for nodes."""
    kept, in_ros_arguments = [], False
    for argument in arguments:
        if argument == "--ros-args":
            in_ros_arguments = True
        elif not in_ros_arguments:
            kept.append(argument)
        elif argument == "--":
            in_ros_arguments = False
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
    parser.suggestions = {"help": "quadtree-lss --help, or COMMAND --help"}
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in (*DESK, *LAB):
        command.add(commands)
    with suppress(ImportError):  # shell completion is optional
        import argcomplete

        argcomplete.autocomplete(parser)
    return parser


if __name__ == "__main__":
    sys.exit(main())
