# SPDX-License-Identifier: Apache-2.0
"""``campaign.html``: verdicts, a scatter plot of the flights, the worst flights, tables."""

from __future__ import annotations

import shlex

import numpy as np

from quadtree_lss.desk.report.pages import Columns, render, source
from quadtree_lss.lab.campaign.summary import CampaignResult, Line, badness, number

#: Colours of combinations, from the palette of Okabe and Ito.
COLOURS = ("#e69f00", "#0072b2", "#cc79a7", "#009e73", "#d55e00", "#56b4e9")
#: Headings of the worst flights.
RANKS = ("worst", "second", "third", "fourth", "fifth")


def page(result: CampaignResult) -> str:
    """Render the page."""
    study, kind, flights = result.study, result.study.kind, result.flown
    note = f"{len(result.records)} of {study.count} flights"
    note += f", {len(result.failed)} failed" if result.failed else ""
    combination = [record.index % len(study.combinations) for record in flights]
    present, columns = sorted(set(combination)), Columns()
    titles = {name: name.replace("_", " ") for name in study.varied}
    titles |= {q.name: q.title for q in kind.quantities}
    means = [q.name for q in kind.quantities if q.of is None]
    first, worst = kind.quantities[0], [(q, pairs) for q, pairs in result.worst() if pairs]
    keep = f"quadtree-lss campaign STUDY.yaml --out {shlex.quote(str(result.out))} --keep"
    return render(
        "lab/campaign/campaign.html",
        title=f"Campaign {study.name}",
        note=f"interrupted: {note}" if result.interrupted else note,
        answers=[_verdict(name, lines[0]) for name, lines in result.lines],
        legend=[(name, COLOURS[k % len(COLOURS)]) for k, (name, _) in enumerate(result.lines)],
        lines=[(name, [line.cells() for line in lines]) for name, lines in result.lines],
        keep=keep,
        ranks=RANKS[: max((len(pairs) for _, pairs in worst), default=0)],
        worst=[
            (q.title, [(f"{v:.{q.digits if q.of is None else 0}f}", k) for k, v in pairs])
            for q, pairs in worst
        ],
        failed=result.failed,
        data={
            "indices": [record.index for record in flights],
            "seeds": [str(record.seed) for record in flights],
            "groups": [present.index(k) for k in combination],
            "colours": list(COLOURS),
            "titles": titles,
            "columns": {
                name: columns.floats(np.array([number(record, name) for record in flights]))
                for name in titles
            },
            "bad": [first.of is not None and badness(first, r) > 0.0 for r in flights],
            "first": [*means[-1:], *means[:1]],
            "command": keep,
        },
        columns=columns.text(),
        program=source("lab/campaign/campaign.js"),
    )


def _verdict(name: str, line: Line) -> tuple[str, str]:
    """Sentence on the first quantity of a combination, and its level of trust."""
    label, value, interval, _, _ = line.cells()
    words = f"{name.rpartition(':')[0]}: {label} {value}, 95 %: {interval}."
    if line.events is None:
        return words, "even"
    bad = line.count - line.events if line.quantity.worst == "smallest" else line.events
    return words, "none" if bad else "good"
