# SPDX-License-Identifier: Apache-2.0
"""Writes the table "What survives what" of docs/onboard.md: `python docs/survives.py`.

Its rows are the arguments of `@pytest.mark.survives(EVENT, EFFECT)` on the tests that show them;
what several tests show of one event stands in one row, a line each. The test's file says under
which heading.
"""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "onboard.md"
TABLE = re.compile(r"(?<=<!-- python docs/survives.py -->\n).*?(?=<!-- end -->)", re.DOTALL)


THEMES = {  # the first of which the test's file has a word
    "Scans and poses": "contradiction|follow|mapping|pose|intake|mount|faults",
    "Ends, restarts and files": "checkpoint|map_files|entry",
    "Maps, areas and keep-outs at `lss_node`": "landing_inputs|received|start",
    "Configuration": "",
}


def table():
    """Of all tests, theme by theme."""
    themes = {theme: {"Event": ["Effect"], "---": ["---"]} for theme in THEMES}
    for path in sorted(ROOT.glob("test/**/test_*.py")):
        rows = themes[next(t for t, words in THEMES.items() if re.search(words, path.stem))]
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            for mark in getattr(node, "decorator_list", []):
                if ast.unparse(mark).startswith("pytest.mark.survives("):
                    event, effect = (ast.literal_eval(text) for text in mark.args)
                    rows.setdefault(event, []).append(effect)
    return "".join(
        f"\n### {theme}\n\n"
        + "".join(f"| {event} | {'<br>'.join(effects)} |\n" for event, effects in rows.items())
        for theme, rows in themes.items()
    )


if __name__ == "__main__":
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(TABLE.sub(lambda _: table(), text), encoding="utf-8")
