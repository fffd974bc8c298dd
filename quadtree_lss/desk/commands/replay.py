# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss replay``, ``sites``, ``info`` and ``doctor``: use of bags and elevation models."""

from __future__ import annotations

import argparse
import shlex
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from quadtree_lss.desk.commands import common, console
from quadtree_lss.desk.replay.files import link_latest, made, new_folder
from quadtree_lss.onboard.errors import QuadtreeLssError

if TYPE_CHECKING:
    from quadtree_lss.desk.replay.results import ReplayResult

TEXT = "Map a recorded bag and rank landing sites, offline and deterministically."
EXAMPLES = """examples:
  quadtree-lss replay flight_bag --config morpheus      (results in results/<time>, and latest)
  quadtree-lss replay flight.mcap --out results --config morpheus --config my_lander.yaml
  quadtree-lss replay flight_bag --out results --start 5 --duration 10 --no-report
  quadtree-lss replay flight_bag --record products      (map and landing topics, for Foxglove)
  quadtree-lss replay products --set lss.margin=1.0     (a bag of maps: sites on the last map)
  quadtree-lss replay flight_bag --publish --rate 0.5   (into running nodes)
  quadtree-lss replay flight_bag --publish --namespace lander --remap lidar/points:=/flash/points
  quadtree-lss replay flight_bag --area='-9,-9 9,-9 9,9 -9,9' --keep-out=none --target=3,-4

Ctrl-C ends the replay and writes the results so far. A second Ctrl-C stops at once.
"""
SITES = "Rank landing sites on an elevation model: GeoTIFF, or .npz with x, y, elevation."
SITES_EXAMPLES = """examples:
  quadtree-lss sites dem.tif                                    (results in results/<time>, latest)
  quadtree-lss sites apollo15.npz --vehicle 9,0.75 --out apollo
  quadtree-lss sites dem.tif --area='0,0 400,0 400,400 0,400'   (cuts the model to the area)

Results are those of replay; coordinates are the model's, which must be in metres with north up.
"""
INFO = "Show what a bag contains and whether it is ready to replay."
INFO_EXAMPLES = """examples:
  quadtree-lss info flight_bag
  quadtree-lss info flight_bag --config vehicle.yaml --json

Exit code 1 if the bag cannot be replayed; the reasons are printed as problems.
"""
DOCTOR = "Find faults of clouds and poses, live or in a bag, and the setting that fixes each one."
DOCTOR_EXAMPLES = """examples:
  quadtree-lss doctor --config vehicle.yaml             (live topics, ten seconds)
  quadtree-lss doctor flight_bag --config vehicle.yaml

Checks frames, axes, units, quaternions, clocks, lag, mount, rates and covariances. Maps the bag as
it is and with each setting that it prints; the last line is the verdict. Move the vehicle while you
record: without motion some faults look alike. Exit code 1 if there is a fault.
"""
RESULTS = Path("results")
OUT = "folder for the results (default results/<time>)"
NO_REPORT = "no figures and no report.html"


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = common.add_command(commands, "replay", _run, TEXT, EXAMPLES)
    add = parser.add_argument
    add("bag", type=common.path, metavar="BAG", help=common.BAG)
    add("--out", metavar="DIR", type=common.path, help=OUT)
    common.add_config_options(parser)
    common.add_topics(parser)
    text = "begin S seconds into the bag"
    add("--start", metavar="S", type=common.not_negative, default=0.0, help=text)
    add("--duration", metavar="D", type=common.positive, help="process D seconds only")
    add("--no-report", action="store_true", help=NO_REPORT)
    text = "write what the nodes would publish, as mcap"
    add("--record", metavar="BAG", type=common.path, help=text)
    add("--publish", action="store_true", help="play into running nodes, with /clock (needs ROS 2)")
    common.add_landing_options(parser, "; none lifts the bag's (default: the bag's topic)")
    add("--namespace", metavar="NS", help="namespace of the topics that --publish sends")
    text = "rename a topic that --publish sends, as in ros2 run; may be repeated"
    add("--remap", metavar="FROM:=TO", action="append", default=[], help=text)
    add("--rate", metavar="R", type=common.positive, help="speed of --publish (default 1)")
    parser = common.add_command(commands, "sites", _sites, SITES, SITES_EXAMPLES)
    add = parser.add_argument
    add("dem", type=common.path, metavar="DEM", help="elevation model, m, z up")
    add("--out", metavar="DIR", type=common.path, help=OUT)
    common.add_config_options(parser)
    add("--no-report", action="store_true", help=NO_REPORT)
    common.add_landing_options(parser, "")
    parser = common.add_command(commands, "info", _info, INFO, INFO_EXAMPLES)
    parser.add_argument("bag", type=common.path, metavar="BAG", help=common.BAG)
    common.add_config_options(parser)
    common.add_topics(parser)
    parser = common.add_command(commands, "doctor", _doctor, DOCTOR, DOCTOR_EXAMPLES)
    add = parser.add_argument
    text = f"{common.BAG}; default: the live topics"
    add("bag", nargs="?", type=common.path, metavar="BAG", help=text)
    common.add_config_options(parser)
    common.add_topics(parser)
    text = "time to listen, s (default 10)"
    add("--seconds", type=common.positive, default=10.0, metavar="S", help=text)


def _run(options: argparse.Namespace) -> int:
    if options.publish:
        return _publish(options)
    common.reject_options(options, "a replay without --publish", "rate", "namespace", "remap")
    from quadtree_lss.desk.replay.replay import replay

    if options.bag.suffix.lower() in (".tif", ".tiff", ".npz"):
        options.parser.error(f"{options.bag} is an elevation model: quadtree-lss sites ranks on it")
    config = common.chosen_config(options)
    out = options.out or new_folder(RESULTS)
    report = "" if options.no_report else ", draws the report"
    after = "ranking sites and writing results" + (" and the report" if report else "")
    then = f"ranks sites on what is mapped so far{report} and writes it into {out}"
    arguments = common.keywords(options, *common.TOPICS, "start", "duration", "record")
    arguments |= {"report": not options.no_report, "landing": common.landing_of(options)}
    with (
        console.interruption(then) as interrupted,
        console.progress_bar("replay", "s", options.verbose, after) as update,
        made(out, QuadtreeLssError),
    ):
        arguments |= {"progress": update, "stop": interrupted}
        result = replay(options.bag, out, config, **arguments)
    _show_result(options, result, out, "warning")
    if result.interrupted or interrupted():
        console.say(f"interrupted: results are of the first {result.summary['duration']:.1f} s")
        return common.INTERRUPTED
    bag = shlex.quote(str(options.bag))
    if result.summary.get("points") and not result.summary["points_used"]:
        console.say(f"no point entered the map: quadtree-lss doctor {bag} finds the cause")
        return common.ERROR
    if result.losses:
        console.warn("the bag is damaged: everything readable was processed")
        return common.IN_PART
    return common.DONE


def _show_result(options: argparse.Namespace, result: ReplayResult, out: Path, word: str) -> None:
    if options.out is None and link_latest(out) is None:
        latest = out.parent / "latest"
        console.warn(f"warning: {latest} does not point at these results: it is not a link")
    for line in result.warnings:
        console.warn(f"{word}: {line}")
    for line in result.losses:
        console.warn(f"damaged: {line}")
    common.show(options, result.as_dict(), console.result_text(result))


def _sites(options: argparse.Namespace) -> int:
    from quadtree_lss.desk.replay.elevation_model import rank_sites

    if options.dem.is_dir() or options.dem.suffix in (".mcap", ".db3", ".bag"):
        what = "is not an elevation model: quadtree-lss replay reads bags"
        options.parser.error(f"{options.dem} {what}")
    config = common.chosen_config(options)
    out = options.out or new_folder(RESULTS)
    arguments = {"report": not options.no_report, "landing": common.landing_of(options)}
    bar = console.progress_bar("sites", "s", options.verbose, "ranking sites, writing the results")
    with made(out, QuadtreeLssError), bar as update:
        update(1, 1)
        result = rank_sites(options.dem, out, config, **arguments)
    _show_result(options, result, out, "note")
    return common.DONE


def _publish(options: argparse.Namespace) -> int:
    offline = "out config set vehicle no_report record area keep_out target".split()
    common.reject_options(options, "--publish: the nodes map and rank the sites", *offline)
    with common.importing_ros("--publish"):
        from quadtree_lss.desk.player.player import play, played_topics
    from quadtree_lss.desk.bags.bag import Bag
    from quadtree_lss.desk.replay.stream import Part

    how = {"rate": options.rate or 1.0, "namespace": options.namespace or ""}
    with Bag(options.bag) as bag, console.progress_bar("play", "s", options.verbose) as update:
        names = played_topics(bag, options.scan_topic, options.pose_topic)
        part = Part.of(bag, options.start, options.duration)
        report = play(bag, names, part, **how, remap=options.remap, progress=update)
    scans = f"{report.scans} scans and {report.poses} poses"
    sent = f"{report.maps} maps" if report.maps else scans
    common.show(options, asdict(report), f"{sent} sent in {report.duration:.1f} s")
    for line in report.losses:
        console.warn(f"damaged: {line}")
    return common.IN_PART if report.losses else common.DONE


def _info(options: argparse.Namespace) -> int:
    from quadtree_lss.desk.replay.info import inspect_bag

    config, arguments = common.chosen_config(options), common.keywords(options, *common.TOPICS)
    with console.progress_bar("info", "s", options.verbose) as update:
        info = inspect_bag(options.bag, config, **arguments, progress=update)
    common.show_result(options, info)
    if not info.works:
        return common.ERROR
    return common.IN_PART if info.losses else common.DONE


def _doctor(options: argparse.Namespace) -> int:
    from quadtree_lss.desk.replay.info import inspect_bag

    config, arguments = common.chosen_config(options), common.keywords(options, *common.TOPICS)
    bag = options.bag
    if bag is None:
        with common.importing_ros("doctor without a bag"):
            from quadtree_lss.desk.player.player import listen
        console.warn(f"listening to the live topics for {options.seconds:g} s")
        bag = listen(options.seconds)
    else:
        common.reject_options(options, "a bag", "seconds")
    with console.progress_bar("doctor", "s", options.verbose) as update:
        info = inspect_bag(bag, config, **arguments, diagnose=True, progress=update)
    faults = [finding for finding in info.findings if finding.fix or finding.fatal]
    notes = [finding for finding in info.findings if finding not in faults]
    faults.sort(key=lambda finding: not finding.fix)  # most of the others follow from these
    none = "as above" if faults and faults[0].fix else "none known"
    shown = [finding for finding in faults if finding.text != info.verdict]
    lines = [f"fault: {finding.text}\nfix:   {finding.fix or none}" for finding in shown]
    lines += [f"note:  {finding.text}" for finding in notes]
    lines += [f"damaged: {text}" for text in info.losses]
    good = "nothing is wrong with the maps" if info.works else "nothing can be mapped: see above"
    lines.append(info.verdict or good)
    findings = [finding._asdict() for finding in (*faults, *notes)]
    content = {"findings": findings, "losses": info.losses, "verdict": info.verdict}
    common.show(options, content, "\n".join(lines))
    if faults:
        return common.ERROR
    return common.IN_PART if info.losses else common.DONE
