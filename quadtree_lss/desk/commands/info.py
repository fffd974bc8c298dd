# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss info`` and ``quadtree-lss doctor``: content of a bag, and its faults."""

from __future__ import annotations

import argparse

from quadtree_lss.desk.commands import common
from quadtree_lss.desk.commands.console import ProgressBar, warn

TEXT = "Show what a bag contains and whether it is ready to replay."
EXAMPLES = """examples:
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


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = common.add_command(commands, "info", _info, TEXT, EXAMPLES)
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


def _info(options: argparse.Namespace) -> int:
    from quadtree_lss.desk.replay.info import inspect_bag

    config, arguments = common.chosen_config(options), common.keywords(options, *common.TOPICS)
    with ProgressBar("info", "s", options.verbose) as bar:
        info = inspect_bag(options.bag, config, **arguments, progress=bar.update)
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
            from quadtree_lss.desk.player.listen import listen
        warn(f"listening to the live topics for {options.seconds:g} s")
        bag = listen(options.seconds)
    else:
        common.reject_options(options, "a bag", "seconds")
    with ProgressBar("doctor", "s", options.verbose) as bar:
        info = inspect_bag(bag, config, **arguments, diagnose=True, progress=bar.update)
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
