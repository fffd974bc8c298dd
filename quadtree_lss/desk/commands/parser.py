# SPDX-License-Identifier: Apache-2.0
"""A parser that says what was likely meant: commands, options and choices."""

from __future__ import annotations

import argparse
import difflib
from collections.abc import Iterable, Sequence
from typing import Any


class Parser(argparse.ArgumentParser):
    """As of argparse; a word that is not known comes with the nearest one that is."""

    def parse_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: Any = None
    ) -> argparse.Namespace:
        """As in the base class; an unknown option is told by the command that has it not."""
        options, unknown = self.parse_known_args(args, namespace)
        if unknown:
            command = getattr(options, "parser", self)
            names = list(command._option_string_actions)
            told = [f"{word}{did_you_mean(word.partition('=')[0], names)}" for word in unknown]
            command.error(f"not understood: {', '.join(told)}")
        return options

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            choices = [str(choice) for choice in action.choices]
            text = f"there is no '{value}'{did_you_mean(str(value), choices)}"
            raise argparse.ArgumentError(action, f"{text} (choices: {', '.join(choices)})")


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """``; did you mean 'replay'?``, or nothing if none is near."""
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f"; did you mean '{close[0]}'?" if close else ""
