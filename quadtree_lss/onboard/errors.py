# SPDX-License-Identifier: Apache-2.0
"""Errors for users, and conversion of received text, such as names of frames, to one line."""

MAX_CHARACTERS = 1000
"""Greatest length of a line in a message."""


def one_line(text: object, most: int = MAX_CHARACTERS) -> str:
    """Return a text as one line of at most ``most`` printable characters, others as escapes."""
    whole = str(text)
    line = whole[: 2 * most]
    if not line.isprintable():
        line = " ".join(line.split())
        line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)
    if len(whole) <= most and len(line) <= most:
        return line
    return f"{line[:most]} ... ({len(whole)} characters)"


class QuadtreeLssError(Exception):
    """An error that the user can fix; its text is one line."""

    def __init__(self, text: object = "") -> None:
        super().__init__(one_line(text))


class OutsideInput(QuadtreeLssError):
    """An argument, such as a time or a position, is outside the recording or model."""
