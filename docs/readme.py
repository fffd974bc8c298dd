# SPDX-License-Identifier: Apache-2.0
"""The table of the README, from tables of docs/evidence.md: `python docs/readme.py`."""

import argparse
import re
import runpy
import sys
from pathlib import Path

FIGURES = runpy.run_path(str(Path(__file__).with_name("figures.py")))["figures"]


def table_of(words):
    """Rows of the table whose command has these words: the first cell to the cells by column."""
    body = next(f.body for f in FIGURES() if f.page.name == "evidence.md" and words in f.command)
    lines = [
        [cell.strip() for cell in line.split("|")[1:-1]] for line in re.findall(r"(?m)^\|.*", body)
    ]
    return {row[0]: dict(zip(lines[0], row, strict=True)) for row in lines[2:]}


def main():
    """Print the table."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    found, top = "Hazardous terrain found [%]", "Unsafe sites in the top five"
    flights, varied = table_of("studies/morpheus")["morpheus"], table_of("studies/varied")["varied"]
    landings = table_of("studies/flight.yaml")["rocks over 12 % of the ground, package"]
    time = table_of("section_vi")["time of all scans, mean, s"]
    counts = [row["unsafe of the ground called safe"] for row in table_of("recordings").values()]
    pairs = [[int(n) for n in text.replace(",", "").split(" of ")] for text in counts]
    unsafe, allowed = map(sum, zip(*pairs, strict=True))
    rows = {
        f"{found}, {flights['flights']} simulated descents": flights[found],
        f"{found}, {varied['flights']} with varied noise, navigation and ground": varied[found],
        f"{top} of the first row": flights[top],
        "Unsafe grid points of the ground called safe, real lidar recordings": (
            f"{unsafe} of {allowed:,} in {len(pairs)} recordings"
        ),
        "Safe touchdowns, simulated landings on rocky ground": landings["Safe touchdowns"],
        "Mapping all scans of the paper's Section VI": (
            f"{time['quadtree']} s on one x86-64 core; the paper reports {time['paper quadtree']} s"
        ),
    }
    print("| Measured | Result |\n| --- | --- |")
    print("\n".join(f"| {name} | {value} |" for name, value in rows.items()))


if __name__ == "__main__":
    try:
        main()
    except KeyError as missing:
        sys.exit(f"docs/evidence.md has no {missing}: make evidence")
