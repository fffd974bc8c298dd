# SPDX-License-Identifier: Apache-2.0
"""Fly or resume a study of ``studies/`` and print one row for each of its combinations.

Flights are kept in ``build/evidence``. Terrains are in the folder ``QUADTREE_LSS_DATA``, by default
``../shared/data`` beside the repository. A mean has its 95 % interval and the worst flight, a count
the 95 % interval of its rate.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from common import data_folder, machine, table

from quadtree_lss.lab.campaign.engine import campaign
from quadtree_lss.lab.campaign.kinds import Value
from quadtree_lss.lab.campaign.study import read_study
from quadtree_lss.lab.campaign.summary import Line, line_of

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("study", type=Path, help="file of the study")
    parser.add_argument("quantities", nargs="+", metavar="QUANTITY", help="a column")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "evidence", help="folder")
    options = parser.parse_args()
    study, out = read_study(options.study), options.out.resolve() / options.study.stem
    out.mkdir(parents=True, exist_ok=True)
    if data_folder().is_dir():
        os.chdir(data_folder())
    print(machine())
    result = campaign(study, out)
    for index, error in result.failed.items():
        print(f"flight {index} failed: {error}", file=sys.stderr)
    known = {quantity.name: quantity for quantity in study.kind.quantities}
    quantities = [known[name] for name in options.quantities]
    count = len(study.combinations)
    labels = [study.case(index).labels for index in range(count)]
    rows = []
    for combination, own in enumerate(labels):
        flown = [record for record in result.flown if record.index % count == combination]
        if flown:
            names = [str(own[label]) for label in varying(labels) if label not in study.drawn]
            cells = [cell(line_of(quantity, flown)) for quantity in quantities]
            rows.append([", ".join(names) or study.name, f"{len(flown)}", *cells])
    table("", ["", "flights", *(quantity.title for quantity in quantities)], rows)


def varying(labels: list[Mapping[str, Value]]) -> list[str]:
    """Names of the labels of combinations, without those that are the same in each case."""
    cases = {own.get("case") for own in labels}
    values = {name: {(own.get("case"), own.get(name)) for own in labels} for name in labels[0]}
    names = [name for name, of_cases in values.items() if len(of_cases) > len(cases)]
    return ["case", *names] if "case" in labels[0] else names


def cell(line: Line) -> str:
    """Format the summary of a quantity."""
    digits = line.quantity.digits
    if line.events is not None:
        interval = f"{100.0 * line.low:.1f}–{100.0 * line.high:.1f} %"
        return f"{line.events:,} of {line.count:,} ({interval})" if line.count else "–"
    if not line.count:
        return "–"
    mean, low, high, worst = (
        f"{value:.{digits}f}" for value in (line.mean, line.low, line.high, line.worst)
    )
    return f"{mean} ({low}–{high}), worst {worst}" if line.count > 1 else mean


if __name__ == "__main__":
    main()
