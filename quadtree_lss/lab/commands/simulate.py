# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss simulate``."""

from __future__ import annotations

import argparse

from quadtree_lss.desk.commands import common
from quadtree_lss.desk.commands.console import Interruption, ProgressBar, say

SCENARIOS = ("morpheus", "parabola", "descent", "drone", "depth")
GIVEN = "seed duration terrain range_noise outliers dropouts flights rocks overwrite".split()
TEXT = "Simulate a flight: a bag, and truth.npz beside it."
FLIGHTS = """flights:
  morpheus   the paper's Section VII: 20 s at 20 Hz on a 30 degree glide slope, 450 m off, 1 degree
             gimballed lidar, over 60 x 60 m of rocks and craters
  parabola   the paper's Section VI exactly: 61 scans at 1 Hz from 500 m, 10 degree lidar
  descent    30 s at 5 Hz from 200 m down to 50 m, looking down with 20 degrees, over 60 x 60 m;
             for measured ground by --terrain
  drone      10 s at 10 Hz from 25 m down to 15 m, looking down with 60 degrees, over 16 x 16 m
  depth      10 s at 5 Hz from 15 m down to 3 m, looking down with a stereo camera's depth images,
             640 x 480, over 8 x 8 m of the drone's ground
--terrain takes an elevation model: GeoTIFF, or .npz with x (nx,), y (ny,) ascending in the same
equal steps and elevation (ny, nx), m, z up, at least 9 x 9 m. Without it morpheus and descent fly
over a field of rocks and craters. The flight is about the model's middle (parabola's about x 10,
y 0): let domain.xmin, domain.ymin, domain.size of the replay fit, or take those of `config suggest
BAG`.

"""
EXAMPLES = """examples:
  quadtree-lss simulate morpheus --seed 7 --out flight/bag      (flight/truth.npz beside it)
  quadtree-lss simulate parabola --seed 1 --out parabola/bag
  quadtree-lss simulate descent --terrain dem.npz --out descent/bag
  quadtree-lss simulate morpheus --flights 2 --outliers 0.02 --dropouts 0.05 --out two/bag

Ctrl-C ends the flight there: bag and truth are those of what was flown so far. A second one
stops at once and leaves no bag.
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    add = common.add_command(commands, "simulate", _run, TEXT, FLIGHTS + EXAMPLES).add_argument
    add("scenario", choices=SCENARIOS, help="which flight")
    text = "of terrain and noise (default 1)"
    add("--seed", type=common.whole(0), default=1, metavar="N", help=text)
    add("--out", required=True, type=common.named, metavar="BAG", help="bag to write")
    add("--duration", type=common.positive, metavar="D", help="seconds of flight")
    text = "elevation model: GeoTIFF, or .npz with x, y, elevation (ny, nx), m"
    add("--terrain", type=common.named, metavar="DEM", help=text)
    add("--range-noise", type=common.not_negative, metavar="M", help="one sigma of a range, m")
    add("--outliers", type=common.share, default=0.0, metavar="F", help="share of false returns")
    add("--dropouts", type=common.share, default=0.0, metavar="F", help="share of missing returns")
    text = "share of the ground that rocks cover"
    add("--rocks", type=common.not_negative, metavar="K", help=text)
    text = "fly N times over the same ground, with other navigation errors, into one bag"
    add("--flights", type=common.whole(1), default=1, metavar="N", help=text)
    add("--overwrite", action="store_true", help="replace an existing bag and truth.npz")


def _run(options: argparse.Namespace) -> int:
    from quadtree_lss.lab.simulation.simulate import simulate

    then = f"closes {options.out} and writes truth.npz for what was flown so far"
    verbose, how = options.verbose, common.given(options, *GIVEN)
    with Interruption(then) as interruption, ProgressBar("simulate", "scans", verbose) as bar:
        how |= {"progress": bar.update, "stop": interruption.asked}
        result = simulate(options.scenario, options.out, **how)
    common.tell(options, result)
    if result.interrupted:
        say(f"interrupted: the bag has the first {result.scans} scans")
        return common.INTERRUPTED
    return common.DONE
