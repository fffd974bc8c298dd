# SPDX-License-Identifier: Apache-2.0
"""``campaign.html``: the result, each flight as a point, the table, the worst flights."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from quadtree_lss.desk.replay.files import write_bytes
from quadtree_lss.desk.report.pages import Columns, render, source
from quadtree_lss.lab.campaign.kinds import Quantity
from quadtree_lss.lab.campaign.store import Record
from quadtree_lss.lab.campaign.summary import (
    CampaignResult,
    Line,
    badness,
    flown,
    groups,
    line_of,
    number,
)
from quadtree_lss.lab.evaluation.figures import RUNS


def page(result: CampaignResult) -> str:
    """The page as text."""
    kind, study = result.study.what, result.study
    note = f"{len(result.records)} of {study.count} flights"
    note += f", {len(result.failed)} failed" if result.failed else ""
    keep = f"quadtree-lss campaign STUDY.yaml --out {shlex.quote(str(result.out))} --keep"
    flights, columns = flown(result.records.values()), Columns()
    parts = groups(study, flights)
    part_of = {record.index: k for k, (_, records) in enumerate(parts) for record in records}
    titles = {name: name.replace("_", " ") for name in (*study.varied, *kind.by)}
    titles |= {q.name: q.title for q in kind.quantities}
    first = kind.first or next((q.name for q in kind.quantities if q.of is None), "")
    return render(
        "lab/campaign/campaign.html",
        title=f"Campaign {study.name}",
        note=f"interrupted: {note}" if result.interrupted else note,
        answers=[
            *_answers_of_all(kind.quantities[0], parts),
            *(_answer(name, lines[0]) for name, lines in result.lines),
        ],
        legend=[(name, RUNS[k % len(RUNS)]) for k, (name, _) in enumerate(parts)],
        lines=[(name, [line.cells() for line in lines]) for name, lines in result.lines],
        keep=keep,
        worst=[
            (q.title, [(f"{v:.{q.digits if q.of is None else 0}f}", k) for k, v in pairs])
            for q, pairs in result.worst()
            if pairs
        ],
        failed=result.failed,
        data={
            "indices": [record.index for record in flights],
            "seeds": [str(record.seed) for record in flights],
            "groups": [part_of[record.index] for record in flights],
            "colours": list(RUNS),
            "titles": titles,
            "columns": {
                name: columns.floats(np.array([number(record, name) for record in flights]))
                for name in titles
            },
            "bad": [
                kind.quantities[0].of is not None and badness(kind.quantities[0], r) > 0.0
                for r in flights
            ],
            "first": [next(iter((*kind.by, *titles))), first],
            "page": kind.page,
            "command": keep,
        },
        columns=columns.text(),
        kept=kept_flights(result.out, kind.page),
        program=source("lab/campaign/campaign.js"),
    )


def kept_flights(out: Path, page: str) -> list[str]:
    return sorted(path.name for path in (out / "kept").glob("*") if (path / page).exists())


def note_kept(out: Path, page: str) -> None:
    """Update the links to kept flights on a campaign's page."""
    path = out / "campaign.html"
    if not path.exists():
        return
    head, mark, rest = path.read_text("utf-8").partition(
        '<script id="kept" type="application/json">'
    )
    if mark:
        tail = rest.partition("</script>")[2]
        found = json.dumps(kept_flights(out, page))
        write_bytes(path, f"{head}{mark}{found}</script>{tail}".encode())


def _answers_of_all(
    quantity: Quantity, parts: Sequence[tuple[str, Sequence[Record]]]
) -> list[tuple[str, str]]:
    """Totals of each scenario with several combinations, if the quantity is a rate."""
    several: dict[str, list[Sequence[Record]]] = {}
    for _, records in parts:
        if records and quantity.of is not None:
            several.setdefault(records[0].scenario, []).append(records)
    return [
        _answer(f"all of {name}:", line_of(quantity, [r for part in found for r in part]))
        for name, found in several.items()
        if len(found) > 1
    ]


def _answer(name: str, line: Line) -> tuple[str, str]:
    """The first quantity of a combination as a sentence, and its colour."""
    label, value, interval, _, _ = line.cells()
    words = f"{name.rpartition(':')[0]}: {label} {value}, 95 %: {interval}."
    if line.events is None:
        return words, "even"
    bad = line.count - line.events if line.quantity.worst == "smallest" else line.events
    return words, "none" if bad else "good"
