# SPDX-License-Identifier: Apache-2.0
"""Plain English in the documents: `python docs/language.py` prints what is not, and fails.

Sentences of at most 36 words, lines of at most 120 characters, no word of REFUSED; no seeds outside
of studies/RESULTS.md; as many cells in each row of a table. `make lint` runs it, and codespell for
spelling.
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
WORDS, COLUMNS = 36, 120
REFUSED = {
    r"(un)?told|owed|hats?": "given, stated, known, due",
    r"(a|the) must|must(?=[:;(|])|musts": "required",
    r"answers?(?! to)": "pass, assessment, result",
    r"give or take|(as|so) (it )?is said|and such|thereof|therein|hitherto": "plainer words",
    r"(map|rules|fits?|versions?|ones?|that|those|flights) of before|before leaves": "history",
    r"earlier revisions?|first version|former(ly)?|used to (be|have|do)": "history",
}
HISTORY = r"seeds? (from )?\d+|flights? \d{2,}(?! (flights|landings))"


def pages():
    """Every page that people read, but for the changelog."""
    patterns = ("*.md", "docs/**/*.md", "msg_docs/*.md", "studies/*.md")
    found = [path for pattern in patterns for path in ROOT.glob(pattern)]
    return sorted(p for p in found if not any(f.is_symlink() for f in (p, *p.parents)))


def without_code(text):
    """Code and comments leave empty lines, code in a line one word."""
    blocks = r"(?ms)^```.*?^```|<!--.*?-->|\$\$.*?\$\$"
    text = re.sub(blocks, lambda match: "\n" * match[0].count("\n"), text)
    return re.sub(r"`[^`\n]*`|\$[^$\n]*\$|\]\([^)]*\)", "x", text)


def sentences(text):
    """(line, words) of each, of paragraphs and items; rows of tables and headings are none."""
    start, words = 1, []
    for number, line in enumerate([*text.splitlines(), ""], 1):
        apart = line.startswith(("|", "#", ":"))
        if apart or not line.strip() or re.match(r"\s*([-*]|\d+\.) ", line):
            yield start, words
            words = []
        for word in [] if apart else line.split():
            start = start if words else number
            words.append(word)
            if re.search(r"[.!?:][)\"*_”]*$", word):
                yield start, words
                words = []


def faults(path):
    """What a reader would stumble over: (line, what)."""
    raw = path.read_text(encoding="utf-8")
    text = without_code(raw)
    for number, line in enumerate(raw.splitlines(), 1):
        if len(line) > COLUMNS and not line.startswith(("|", "<!-- figure:")):
            yield number, f"a line of {len(line)} characters"
    for number, line in enumerate(text.splitlines(), 1):
        for pattern, better in REFUSED.items():
            for match in re.finditer(rf"(?i)\b(?:{pattern})(?!\w)", line):
                yield number, f"'{match[0]}': {better}"
        if path.name != "RESULTS.md" and (match := re.search(HISTORY, line, re.IGNORECASE)):
            yield number, f"'{match[0]}' belongs to studies/RESULTS.md"
    width = 0
    for number, line in enumerate(text.replace(r"\|", "").splitlines(), 1):
        cells = line.count("|") if line.startswith("|") else 0
        if cells and width and cells != width:
            yield number, f"a row of {cells - 1} cells under one of {width - 1}"
        width = cells
    for number, words in sentences(text):
        if len(words) > WORDS:
            yield number, f"a sentence of {len(words)} words: {' '.join(words[:6])} …"


if __name__ == "__main__":
    found = [f"{p.relative_to(ROOT)}:{n}: {what}" for p in pages() for n, what in sorted(faults(p))]
    print("\n".join(found) or "the documents are plain")
    sys.exit(bool(found))
