# SPDX-License-Identifier: Apache-2.0
"""Landing ground on recordings of real lidars with suggested configurations.

For each recording: ``config suggest BAG --vehicle 3.7,0.3``, ``replay``, and the contact check of
``measured_points.py judge``, which is stored with the recordings. That script sets the vehicle down
on the highest measured returns at each grid point whose ground was measured densely. The folder of
the recordings is ``QUADTREE_LSS_DATA``, by default ``../shared/data`` beside the repository.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parent))

from common import data_folder, machine, table

PROGRAM = Path(sys.executable).with_name("quadtree-lss")
VEHICLE = "3.7,0.3"


class Recording(NamedTuple):
    """Title in the table, and parameters: evaluated on cells of ``cell`` m without gaps over
    ``gap`` m. ``points``: the measured points, by default those of the bag; ``flown``: the bag is a
    virtual flight over them."""

    title: str
    cell: float = 0.15
    gap: float = 0.6
    points: str = ""
    flown: bool = False


RECORDINGS = {
    "autzen_meadow": Recording("airborne returns, meadow", 0.5, 1.0),
    "ign": Recording("flash lidar over 160,000 airborne returns", 0.4, 1.0, "ign", flown=True),
    "ign_asis": Recording("the same returns, once each, in 40 strips", 0.4, 1.0, "ign"),
    "os1_2048": Recording("one turn, 64 lines, street"),
    "vls128": Recording("one turn, 128 lines, crossing"),
    "lone": Recording("flash lidar over a terrestrial scan, wood", 0.1, 0.6, "lone", flown=True),
    "ouster_os1": Recording("three turns, street crossing"),
}
HEADER = ["recording", "safe in truth, %", "of it called safe, %"]
HEADER += ["unsafe of the ground called safe"]


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=data_folder(), help="folder of the recordings")
    parser.add_argument("names", nargs="*", metavar="NAME", help="recordings (default: all)")
    options = parser.parse_args()
    script = options.data / "measured_points.py"
    if not script.exists():
        print(f"no recordings in {options.data}; {machine()}")
        return 0
    print(machine())
    rows = []
    for name in options.names or RECORDINGS:
        with tempfile.TemporaryDirectory() as scratch:
            found = evaluated(name, RECORDINGS[name], script.resolve(), Path(scratch))
        refused = found["good_and_refused_percent"]
        bad = f"{found['allowed_and_bad']} of {found['allowed']:,}"
        title = RECORDINGS[name].title
        rows.append([title, found["good_percent"], f"{100.0 - refused:.1f}", bad])
        print(f"{name}: {rows[-1][1:]}", file=sys.stderr, flush=True)
    table("", HEADER, rows)
    return 0


def evaluated(name: str, recording: Recording, script: Path, scratch: Path) -> dict[str, float]:
    """Suggest a configuration, replay with it, and compare the result with the measured points."""
    bag, config, out = script.parent / name, scratch / "suggested.yaml", scratch / "out"
    if recording.flown:
        bag = scratch / name
        run(sys.executable, script, "fly", recording.points, bag)
    config.write_text(run(PROGRAM, "config", "suggest", bag, "--vehicle", VEHICLE), "utf-8")
    run(PROGRAM, "replay", bag, "--config", config, "--out", out, "--no-report", "--quiet")
    how = ["--vehicle", VEHICLE, "--cell", recording.cell, "--gap", recording.gap]
    return json.loads(run(sys.executable, script, "judge", out, recording.points or bag, *how))


def run(*words: object) -> str:
    """Run a program and return what it prints."""
    command = [str(word) for word in words]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout


if __name__ == "__main__":
    sys.exit(main())
