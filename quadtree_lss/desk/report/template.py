# SPDX-License-Identifier: Apache-2.0
"""The frame of every page: one HTML file that needs nothing else and loads nothing.

A page of another room is `document` with a body of its own, `table` and the classes of
``page.css``; without ``scripts`` it needs no JavaScript.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import Any

from quadtree_lss.desk.report.packing import Columns, compressed

# Nothing may be loaded from anywhere, whatever stands in a topic's name.
POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"
#: What stands to the right in a table: a number, with its unit, and so many of so many.
NUMBER = re.compile(r"[-+−]?[\d.,]+( of [\d,]+| \w{1,3}| %)?")


def document(
    title: str,
    body: str,
    *,
    data: Mapping[str, Any] | None = None,
    columns: Columns | None = None,
    scripts: Sequence[str] = (),
    styles: Sequence[str] = ("page.css",),
    libraries: Mapping[str, str] | None = None,
) -> str:
    """A page as text.

    Args:
        title: Plain text.
        body: Markup.
        data, columns: What the scripts draw; element ``data`` and ``columns``.
        scripts, styles: Files of this folder, in their order.
        libraries: Files of this folder that run when a script asks for them (`loadLibrary`), by
            the identifier of their element.
    """
    parts = []
    for name, file in (libraries or {}).items():
        text = compressed(source(file).encode())
        parts.append(f'<script id="{name}" type="text/plain">{text}</script>')
    if columns is not None:
        parts.append(f'<script id="columns" type="text/plain">{columns.text()}</script>')
    if data is not None:
        # A browser ends a script at the first "</script", wherever it stands.
        embedded = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
        parts.append(f'<script id="data" type="application/json">{embedded}</script>')
    if scripts:
        program = "\n".join(map(source, scripts))
        parts.append(f"<script>\n{program}</script>")
    style = "\n".join(map(source, styles))
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        f"<title>{escape(title)}</title><style>\n{style}</style></head>\n"
        f"<body>\n{body}\n" + "\n".join(parts) + "\n</body></html>\n"
    )


def source(name: str) -> str:
    """A file of this folder."""
    return files("quadtree_lss.desk.report").joinpath(name).read_text("utf-8")


class Markup(str):
    """A value of a table that is markup already."""


def table(
    header: Sequence[str],
    rows: Iterable[Iterable[object]],
    marks: Iterable[str] | None = None,
    attributes: str = "",
) -> str:
    """Rows of values, escaped but for `Markup`; ``marks`` are attributes of each row."""
    rows = [tuple(row) for row in rows]
    marks = [""] * len(rows) if marks is None else list(marks)
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join(
        f"<tr{mark}>" + "".join(map(_cell, row)) + "</tr>"
        for mark, row in zip(marks, rows, strict=True)
    )
    head = f"<thead><tr>{head}</tr></thead>" if head else ""
    return f'<div class="scroll"><table{attributes}>{head}<tbody>{body}</tbody></table></div>'


def plain_table(rows: Iterable[Iterable[object]]) -> str:
    """Names and values."""
    return table((), rows, attributes=' class="plain"')


def _cell(value: object) -> str:
    if isinstance(value, Markup):
        return f"<td>{value}</td>"
    text = str(value)
    number = not any(map(str.isalpha, text)) or NUMBER.fullmatch(text)
    kind = "" if number else ' class="text"'
    return f"<td{kind}>{escape(text)}</td>"
