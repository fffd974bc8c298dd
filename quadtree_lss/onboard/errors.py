# SPDX-License-Identifier: Apache-2.0
"""The exception every error meant for a user derives from, and text from outside made fit to show.

Frames, topics and names of files come from whoever sent them: they may hold line ends, which fake
lines of a log, escapes, which a terminal obeys, and megabytes.
"""

MOST_CHARACTERS = 1000
"""Of one line that is shown."""


def one_line(text: object, most: int = MOST_CHARACTERS) -> str:
    """Text as one line of printable characters, others as escapes, cut beyond ``most``."""
    whole = str(text)
    line = whole[: 2 * most]
    if not line.isprintable():
        line = " ".join(line.split())
        line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)
    if len(whole) <= most and len(line) <= most:
        return line
    return f"{line[:most]} ... ({len(whole)} characters)"


class QuadtreeLssError(Exception):
    """Something the user can mend; its text is one clear line."""

    def __init__(self, text: object = "") -> None:
        super().__init__(one_line(text))


class OutsideInput(QuadtreeLssError):
    """An argument, such as a time or a place, lies outside of the recording or model."""
