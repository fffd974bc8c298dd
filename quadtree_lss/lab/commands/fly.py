# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss fly`` and ``simulate``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from quadtree_lss.desk.commands import common, console
from quadtree_lss.onboard.errors import QuadtreeLssError

if TYPE_CHECKING:
    from quadtree_lss.lab.flight.fly import FlightResult
    from quadtree_lss.lab.flight.settings import FlightSettings

Progress = Callable[[float], None]

TEXT = "Fly a simulated lander to a touchdown, guided by landing/selected."
EXAMPLES = """examples:
  quadtree-lss fly --seed 7 --out flight7                  (flight7/flight.html, touchdown.json)
  quadtree-lss fly --lockstep --seed 7 --out lockstep7     (the same without ROS)
  quadtree-lss fly --lockstep --avoidance none --out straight
  quadtree-lss fly --lockstep --fault kill_mapping@60+3 --out fault
"""
AVOIDANCE = ("package", "paper", "none", "perfect")
#: Time at which the progress bar is full, s.
MAX_TIME_S = 100.0
TERRAIN = "elevation model: GeoTIFF, or .npz with x, y, elevation (ny, nx), m"
SCENARIOS = ("morpheus", "parabola", "descent", "drone", "depth")
SIMULATE_OPTIONS = "seed duration terrain range_noise outliers dropouts flights rocks".split()
SIMULATE = "Simulate a flight: a bag, and truth.npz beside it."
FLIGHTS = """flights:
  morpheus   Section VII of the paper: 20 s at 20 Hz on a 30 degree glide slope from 450 m, 1 degree
             gimballed lidar, 60 x 60 m of rocks and craters
  parabola   Section VI of the paper: 61 scans at 1 Hz from 500 m, 10 degree lidar
  descent    30 s at 5 Hz from 200 m to 50 m, 20 degree lidar, 60 x 60 m
  drone      10 s at 10 Hz from 25 m to 15 m, 60 degree lidar, 16 x 16 m
  depth      10 s at 5 Hz from 15 m to 3 m, depth images of 640 x 480, 8 x 8 m
--terrain takes a GeoTIFF, or .npz with x (nx,), y (ny,) ascending in equal steps and elevation
(ny, nx), m, z up, at least 9 x 9 m. The flight is around its middle (parabola: x 10, y 0): set
domain.xmin, domain.ymin, domain.size of the replay, for example with `config suggest BAG`.

"""
SIMULATE_EXAMPLES = """examples:
  quadtree-lss simulate morpheus --seed 7 --out flight/bag      (flight/truth.npz beside it)
  quadtree-lss simulate parabola --seed 1 --out parabola/bag
  quadtree-lss simulate descent --terrain dem.npz --out descent/bag
  quadtree-lss simulate morpheus --flights 2 --outliers 0.02 --dropouts 0.05 --out two/bag

Ctrl-C ends the flight there: bag and truth are those of what was flown so far. A second one
stops at once and leaves no bag.
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    text = FLIGHTS + SIMULATE_EXAMPLES
    add = common.add_command(commands, "simulate", _simulate, SIMULATE, text).add_argument
    add("scenario", choices=SCENARIOS, help="which flight")
    text = "of terrain and noise (default 1)"
    add("--seed", type=common.whole(0), default=1, metavar="N", help=text)
    text = "bag to write (default SCENARIO_SEED/bag)"
    add("--out", type=common.path, metavar="BAG", help=text)
    add("--duration", type=common.positive, metavar="D", help="seconds of flight")
    add("--terrain", type=common.path, metavar="DEM", help=TERRAIN)
    add("--range-noise", type=common.not_negative, metavar="M", help="one sigma of a range, m")
    add("--outliers", type=common.share, default=0.0, metavar="F", help="share of false returns")
    add("--dropouts", type=common.share, default=0.0, metavar="F", help="share of missing returns")
    text = "share of the ground that rocks cover"
    add("--rocks", type=common.not_negative, metavar="K", help=text)
    text = "fly N times over the same ground, with other navigation errors, into one bag"
    add("--flights", type=common.whole(1), default=1, metavar="N", help=text)
    add("--overwrite", action="store_true", help="replace an existing bag and truth.npz")
    add = common.add_command(commands, "fly", _fly, TEXT, EXAMPLES).add_argument
    text = "of ground, start, navigation, lidar"
    add("--seed", type=common.whole(0), default=1, metavar="N", help=text)
    text = "folder for the results (default results/<time>)"
    add("--out", type=common.path, metavar="DIR", help=text)
    text = "without ROS: the nodes' functions, called in the flight's own time"
    add("--lockstep", action="store_true", help=text)
    text = "by the nodes; by the paper's rules; straight to the planned point; by the true ground"
    add("--avoidance", choices=AVOIDANCE, default="package", help=text)
    add("--terrain", type=common.path, metavar="DEM", help=TERRAIN)
    text = "share of the ground that rocks cover (default 0.05, with --terrain none)"
    add("--rocks", type=common.share, metavar="K", help=text)
    text = "KIND@HEIGHT or KIND@HEIGHT+SECONDS; may be repeated; kinds in studies/RESULTS.md"
    add("--fault", action="append", default=[], metavar="FAULT", help=text)
    text = "set one parameter of the nodes, for instance lss.margin=1.0"
    add("--set", action="append", default=[], metavar="KEY=VALUE", help=text)


def _fly(options: argparse.Namespace) -> int:
    from quadtree_lss.desk.replay.files import made, new_folder, write_json
    from quadtree_lss.lab.flight.flight_page import headline, write_flight
    from quadtree_lss.lab.flight.fly import fly_lockstep
    from quadtree_lss.lab.flight.settings import flight_settings

    options.out = options.out or new_folder(Path("results"))
    given = {
        "avoidance": options.avoidance,
        "terrain": str(options.terrain or ""),
        "rocks": options.rocks,
        "faults": tuple(options.fault),
        "config": common.overrides(options),
    }
    settings = flight_settings(given)
    lockstep = options.lockstep or options.avoidance in ("none", "perfect")
    figures = {"seed": options.seed, "avoidance": options.avoidance, "outcome": "none"}
    bar = console.progress_bar("fly", "s", options.verbose)
    with made(options.out, QuadtreeLssError), bar as update:
        progress = partial(update, total=MAX_TIME_S)
        try:
            if lockstep:
                done = fly_lockstep(options.seed, settings, progress=progress, record=True)
            else:
                done = _live(options, settings, progress)
        except BaseException as error:
            figures |= {"safe": False, "reason": console.first_line(error)}
            write_json(options.out / "touchdown.json", figures)
            raise
    write_flight(options.out, done)
    if done.figures["warnings"]:
        console.warn(f"warning: {done.figures['warnings']}")
    common.show(options, done.figures, f"{headline(done)}\nresults in {options.out}")
    return common.DONE


def _live(
    options: argparse.Namespace, settings: FlightSettings, progress: Progress
) -> FlightResult:
    try:
        from quadtree_lss.lab.live.flight import fly_live
        from quadtree_lss.lab.live.processes import environment_domain
    except ImportError as error:
        msg = f"ROS 2 is not available ({console.first_line(error)}); --lockstep flies without it"
        raise QuadtreeLssError(msg) from None
    live = options.out / "nodes"
    return fly_live(options.seed, settings, live, progress=progress, domain=environment_domain())


def _simulate(options: argparse.Namespace) -> int:
    from quadtree_lss.lab.simulation.simulate import simulate

    options.out = options.out or Path(f"{options.scenario}_{options.seed}", "bag")
    consequence = f"closes {options.out} and writes truth.npz for what was flown so far"
    how = common.keywords(options, *SIMULATE_OPTIONS, "overwrite")
    bar = console.progress_bar("simulate", "scans", options.verbose)
    with console.interruption(consequence) as interrupted, bar as update:
        how |= {"progress": update, "stop": interrupted}
        result = simulate(options.scenario, options.out, **how)
    common.show_result(options, result)
    if result.interrupted:
        console.say(f"interrupted: the bag has the first {result.scans} scans")
        return common.INTERRUPTED
    return common.DONE
