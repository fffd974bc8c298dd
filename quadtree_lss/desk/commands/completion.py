# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss completion``, and what the shell completes: by argcomplete."""

from __future__ import annotations

import argparse
import os
from typing import Any

from quadtree_lss.desk.commands.common import add_command, config_names

TEXT = "Print what makes a shell complete commands, options and names."
EXAMPLES = """examples:
  eval "$(quadtree-lss completion bash)"                     (in ~/.bashrc)
  eval "$(quadtree-lss completion zsh)"                      (in ~/.zshrc, after compinit)
  quadtree-lss completion fish > ~/.config/fish/completions/quadtree-lss.fish
"""
SHELLS = ("bash", "zsh", "fish", "tcsh", "powershell")


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declares the subcommand."""
    parser = add_command(commands, "completion", _run, TEXT, EXAMPLES, as_json=False)
    parser.add_argument("shell", choices=SHELLS, help="which shell")


def _run(options: argparse.Namespace) -> int:
    from argcomplete import shellcode

    print(shellcode(["quadtree-lss"], shell=options.shell))
    return 0


def complete(parser: argparse.ArgumentParser) -> None:
    """Answers the shell and ends, if it is the shell that asks."""
    if "_ARGCOMPLETE" in os.environ:
        import argcomplete

        argcomplete.autocomplete(parser)


def names_of_action(prefix: str, parsed_args: argparse.Namespace, **_: Any) -> list[str]:
    """Of ``config``: keys and sections to explain, files to check, bags."""
    from argcomplete.completers import FilesCompleter

    from quadtree_lss.onboard.config.settings import parameters

    if parsed_args.action == "explain":
        names = [row.name for row in parameters()]
        return [*sorted({name.partition(".")[0] for name in names}), *names]
    if parsed_args.action == "check":
        return config_names(prefix)
    return list(FilesCompleter()(prefix))
