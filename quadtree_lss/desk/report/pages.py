# SPDX-License-Identifier: Apache-2.0
"""Pages: one HTML file each that needs nothing else and loads nothing, made of a jinja2 template.

A template is named by its place in the package and extends ``desk/report/page.html``, which has
the look of all (``page.css``) and the policy; ``desk/report/macros.html`` has tables and pictures.
All text is escaped. A page without scripts needs no JavaScript.
"""

from __future__ import annotations

import base64
import re
import zlib
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup
from numpy.typing import ArrayLike, NDArray

#: What stands to the right in a table: a number, with its unit, and so many of so many.
NUMBER = re.compile(r"[-+−]?[\d.,]+( of [\d,]+| \w{1,3}| %)?")
_NONE = {"u1": 0xFF, "u2": 0xFFFF}


def render(template: str, **values: Any) -> str:
    """The page that a template, such as ``lab/flight/flight.html``, makes of values; what cannot be
    encoded, as in names of files that are no UTF-8, is a question mark."""
    text = _environment().get_template(template).render(**values)
    return text.encode(errors="replace").decode()


def source(name: str) -> str:
    """A text file of the package."""
    return files("quadtree_lss").joinpath(name).read_text("utf-8")


def compressed(content: bytes) -> str:
    """As a page carries it; `inflate` of ``columns.js`` undoes it."""
    return base64.b64encode(zlib.compress(content, 9)).decode()


def is_words(value: object) -> bool:
    """Whether a cell of a table is text, which stands to the left; markup and numbers are not."""
    text = str(value)
    number = not any(map(str.isalpha, text)) or NUMBER.fullmatch(text)
    return not number and not isinstance(value, Markup)


@cache
def _environment() -> Environment:
    found = Environment(
        loader=FunctionLoader(source),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.policies["json.dumps_kwargs"] = {"allow_nan": False}
    found.globals["source"] = lambda name: source(f"desk/report/{name}")
    found.filters["compressed"] = lambda text: compressed(text.encode())
    found.filters["base64"] = lambda content: base64.b64encode(content).decode()
    found.tests["words"] = is_words
    return found


class Columns:
    """Arrays inside a page: columns one after the other, compressed, in base64.

    What each call returns tells ``columns.js`` where the column is.
    """

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._end = 0
        self._known: dict[bytes, int] = {}

    def quantised(
        self, values: ArrayLike, kind: str = "u2", least: float = 0.0, **more: Any
    ) -> dict[str, Any]:
        """Entry i is low + step · data[i], with steps of ``least`` or more; the greatest number
        stands for NaN. ``more`` is told of it besides."""
        flat = np.asarray(values, dtype=np.float64).ravel()
        finite = np.isfinite(flat)
        low, high = (flat[finite].min(), flat[finite].max()) if finite.any() else (0.0, 0.0)
        top = _NONE[kind] - 1
        step = max(float(high - low) / top, least) if high > low else 1.0
        data = np.full(flat.shape, _NONE[kind], dtype=f"<{kind}")
        data[finite] = np.rint((flat[finite] - low) / step)
        return {"low": float(low), "step": step, **self._add(data, kind), **more}

    def whole(self, values: NDArray[Any], kind: str) -> dict[str, Any]:
        """Integers as they are, kind ``u1``, ``u2`` or ``u4``."""
        return self._add(np.asarray(values).astype(f"<{kind}"), kind)

    def floats(self, values: NDArray[Any]) -> dict[str, Any]:
        """Single precision."""
        return self._add(np.asarray(values).astype("<f4"), "f4")

    def text(self) -> str:
        """All of them."""
        return compressed(b"".join(self._parts))

    def _add(self, data: NDArray[Any], kind: str) -> dict[str, Any]:
        raw = data.tobytes()
        raw += bytes(-len(raw) % 4)  # so that every column can be looked at where it lies
        start = self._known.setdefault(raw, self._end)
        if start == self._end:
            self._parts.append(raw)
            self._end += len(raw)
        return {"kind": kind, "at": start, "length": data.size}
