# SPDX-License-Identifier: Apache-2.0
"""Self-contained HTML pages from jinja2 templates, with all text escaped.

A template is named by its path in the package and extends ``desk/report/page.html``.
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

#: A cell that is aligned to the right: a number with its unit or its total.
NUMBER = re.compile(r"[-+−]?[\d.,]+( of [\d,]+| \w{1,3}| %)?")
_NAN_CODES = {"u1": 0xFF, "u2": 0xFFFF}


def render(template: str, **values: Any) -> str:
    """Fill a template; invalid UTF-8, as in file names, becomes question marks."""
    text = _environment().get_template(template).render(**values)
    return text.encode(errors="replace").decode()


def source(name: str) -> str:
    """Read a text file of the package."""
    return files("quadtree_lss").joinpath(name).read_text("utf-8")


def compressed(content: bytes) -> str:
    """Compress bytes for a page; ``inflate`` in ``columns.js`` expands them."""
    return base64.b64encode(zlib.compress(content, 9)).decode()


def is_words(value: object) -> bool:
    """Whether a table cell is text, aligned to the left, and not markup or a number."""
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
    found.tests["words"] = is_words
    return found


class Columns:
    """Compressed arrays of a page. Each method returns where ``columns.js`` finds the array."""

    def __init__(self) -> None:
        self._end = 0
        self._starts: dict[bytes, int] = {}

    def quantised(
        self, values: ArrayLike, kind: str = "u2", min_step: float = 0.0, **extra: Any
    ) -> dict[str, Any]:
        """Add values as low + step · data[i] with step >= ``min_step``; the largest integer is NaN.
        The result includes ``extra``."""
        flat = np.asarray(values, dtype=np.float64).ravel()
        finite = np.isfinite(flat)
        low, high = (flat[finite].min(), flat[finite].max()) if finite.any() else (0.0, 0.0)
        top = _NAN_CODES[kind] - 1
        step = max(float(high - low) / top, min_step) if high > low else 1.0
        data = np.full(flat.shape, _NAN_CODES[kind], dtype=f"<{kind}")
        data[finite] = np.rint((flat[finite] - low) / step)
        return {"low": float(low), "step": step, **self._add(data, kind), **extra}

    def whole(self, values: NDArray[Any], kind: str) -> dict[str, Any]:
        """Add integers of kind ``u1``, ``u2`` or ``u4``."""
        return self._add(np.asarray(values).astype(f"<{kind}"), kind)

    def floats(self, values: NDArray[Any]) -> dict[str, Any]:
        """Add numbers in single precision."""
        return self._add(np.asarray(values).astype("<f4"), "f4")

    def text(self) -> str:
        """The content of all columns."""
        return compressed(b"".join(self._starts))

    def _add(self, data: NDArray[Any], kind: str) -> dict[str, Any]:
        raw = data.tobytes()
        raw += bytes(-len(raw) % 4)  # typed arrays must be aligned
        start = self._starts.setdefault(raw, self._end)
        if start == self._end:
            self._end += len(raw)
        return {"kind": kind, "at": start, "length": data.size}
