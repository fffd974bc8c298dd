# SPDX-License-Identifier: Apache-2.0
"""Write the page of the commands: `python docs/commands.py > docs/commands.md`."""

import argparse
import sys
import textwrap
from collections import Counter
from collections.abc import Iterator

from quadtree_lss import cli

INTRODUCTION = """\
# Commands

<!-- From the parsers of quadtree_lss/cli.py by: python docs/commands.py > docs/commands.md -->

`quadtree-lss COMMAND --help` shows the same options, with examples. With ROS,
`ros2 run quadtree_lss` also offers `replay_bag`, `simulate`, `evaluate` and `quadtree-lss`.

Exit codes: 0 done, 1 error, 2 wrong usage, 3 done in part (damaged input), 130 interrupted.

## Shared options

All commands have the first four. A command that has one of the others lists its name.

"""
#: Options with the same text in at least this many commands are described once.
SHARED = 3
Option = tuple[str, str]


def commands_page() -> str:
    """Return the page."""
    parsers = dict(_commands(cli._parser(), "quadtree-lss"))
    options = {name: [*_options(parser)] for name, parser in parsers.items()}
    count = Counter(option for listed in options.values() for option in listed)
    shared = [option for option, number in count.items() if number >= SHARED]
    parts = [INTRODUCTION + _list(shared)]
    for name, parser in parsers.items():
        own = [option for option in options[name] if option not in shared]
        also = [o for o in options[name] if o in shared and count[o] < len(parsers)]
        operands = "".join(f" {typed}" for typed, _ in options[name] if typed[0] != "-")
        parts.append(f"\n## {name.removeprefix('quadtree-lss ')}\n\n`{name}{operands}`\n\n")
        parts.append(textwrap.fill(str(parser.description), 100) + "\n")
        parts.append(f"\n{_list(own)}" if own else "")
        words = ", ".join(f"`{typed.split()[0]}`" for typed, _ in also)
        parts.append(f"\nShared: {words}.\n" if also else "")
    return "".join(parts)


def _commands(
    parser: argparse.ArgumentParser, name: str
) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield the commands of a parser, and their actions, by name."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for word, command in action.choices.items():
                yield f"{name} {word}", command
                yield from _commands(command, f"{name} {word}")


def _options(parser: argparse.ArgumentParser) -> Iterator[Option]:
    """Yield options and operands as they are typed, and what they do."""
    formatter = parser._get_formatter()
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            yield str(action.metavar), str(action.help)
            continue
        value = ""
        if action.nargs != 0:
            default = formatter._get_default_metavar_for_optional(action)
            (value,) = formatter._metavar_formatter(action, default)(1)
        typed = f"{', '.join(action.option_strings)} {value}".strip()
        yield typed, formatter._expand_help(action)


def _list(options: list[Option]) -> str:
    # GitHub hides what looks like a tag.
    lines = (
        textwrap.fill(f"- `{typed}`: {does}", 100, subsequent_indent="  ", break_on_hyphens=False)
        for typed, does in options
    )
    return "\n".join(lines).replace("<", "\\<") + "\n"


if __name__ == "__main__":
    sys.stdout.write(commands_page())
