# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss fly``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from quadtree_lss.desk.commands import common
from quadtree_lss.desk.commands.console import ProgressBar, first_line, say, warn
from quadtree_lss.onboard.errors import QuadtreeLssError

if TYPE_CHECKING:
    from quadtree_lss.lab.flight.fly import Flown
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
LONGEST = 100.0


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    add = common.add_command(commands, "fly", _run, TEXT, EXAMPLES).add_argument
    text = "of ground, start, navigation, lidar"
    add("--seed", type=common.whole(0), default=1, metavar="N", help=text)
    add("--out", required=True, type=common.named, metavar="DIR", help="folder for the results")
    text = "without ROS: the nodes' functions, called in the flight's own time"
    add("--lockstep", action="store_true", help=text)
    text = "speed of a flight over ROS (default 1); nodes go by /clock"
    add("--rate", type=common.positive, metavar="R", help=text)
    text = "by the nodes; by the paper's rules; straight to the planned point; by the true ground"
    add("--avoidance", choices=AVOIDANCE, default="package", help=text)
    text = "elevation model: GeoTIFF, or .npz with x, y, elevation (ny, nx), m"
    add("--terrain", type=common.named, metavar="DEM", help=text)
    text = "share of the ground that rocks cover (default 0.05, with --terrain none)"
    add("--rocks", type=common.share, metavar="K", help=text)
    text = "KIND@HEIGHT or KIND@HEIGHT+SECONDS; may be repeated; kinds in docs/closed_loop.md"
    add("--fault", action="append", default=[], metavar="FAULT", help=text)
    text = "set one parameter of the nodes, for instance lss.margin=1.0"
    add("--set", action="append", default=[], metavar="KEY=VALUE", help=text)
    add("--physics", action="store_true", help="touch down on legs as well (extra 'physics')")
    add("--no-page", action="store_true", help="no picture and no page")


def _run(options: argparse.Namespace) -> int:
    from quadtree_lss.desk.replay.files import write_json
    from quadtree_lss.lab.flight.flight_page import headline, write_flight
    from quadtree_lss.lab.flight.fly import flown
    from quadtree_lss.lab.flight.settings import flight_settings

    settings = flight_settings(_values(options))
    alone = options.lockstep or options.avoidance in ("none", "perfect")
    if alone and options.rate is not None:
        options.parser.error("--rate: only over ROS, not with --lockstep")
    figures = {"seed": options.seed, "avoidance": options.avoidance, "outcome": "none"}
    with ProgressBar("fly", "s", options.verbose) as bar:
        progress = partial(bar.update, total=LONGEST)
        try:
            if alone:
                done = flown(options.seed, settings, progress=progress, record=not options.no_page)
            else:
                done = _live(options, settings, progress)
        except BaseException as error:
            figures |= {"safe": False, "reason": first_line(error)}
            write_json(options.out / "touchdown.json", figures)
            raise
    write_flight(options.out, done, report=not options.no_page)
    if done.figures["warnings"]:
        warn(f"warning: {done.figures['warnings']}")
    common.show(options, done.figures, f"{headline(done)}\nresults in {options.out}")
    if others := done.figures.get("others"):
        say(f"error: the flight says nothing, for others published {'; '.join(others)}")
        return common.ERROR
    return common.DONE


def _live(options: argparse.Namespace, settings: FlightSettings, progress: Progress) -> Flown:
    try:
        from quadtree_lss.lab.live.flight import fly_live
        from quadtree_lss.lab.live.processes import given_domain
    except ImportError as error:
        msg = f"ROS 2 is not here ({first_line(error)}); --lockstep flies without"
        raise QuadtreeLssError(msg) from None
    rate = 1.0 if options.rate is None else options.rate
    live = options.out / "nodes"
    how: dict[str, Any] = {"rate": rate, "progress": progress, "domain": given_domain()}
    return fly_live(options.seed, settings, live, **how)


def _values(options: argparse.Namespace) -> dict[str, Any]:
    return {
        "avoidance": options.avoidance,
        "terrain": str(options.terrain or ""),
        "rock_abundance": options.rocks,
        "faults": tuple(options.fault),
        "config": common.overrides(options),
        "judge": "physics" if options.physics else "contact",
    }
