# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss info`` and ``quadtree-lss doctor``: what a bag is, and what is wrong with it."""

from __future__ import annotations

import argparse

from quadtree_lss.desk.commands import common
from quadtree_lss.desk.commands.console import ProgressBar, warn

TEXT = "Show what a bag contains and whether it is ready to replay."
EXAMPLES = """examples:
  quadtree-lss info flight_bag
  quadtree-lss info flight_bag --config vehicle.yaml --json

Exit code 1 if it cannot be replayed, for the reasons printed as problems.
"""
DOCTOR = "Find faults of clouds and poses, live or in a bag, and the setting that fixes each one."
DOCTOR_EXAMPLES = """examples:
  quadtree-lss doctor --config vehicle.yaml             (the topics that are live now, ten seconds)
  quadtree-lss doctor flight_bag --config vehicle.yaml

Checks frames, axes, units, quaternions, clocks, lag, mount, rates and covariances. Maps the bag as
it is and with each setting that it prints; the last line is the verdict. Move the vehicle while you
record: without motion some faults look alike. Exit code 1 if there is a fault.
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = common.add_command(commands, "info", _info, TEXT, EXAMPLES)
    parser.add_argument("bag", type=common.named, metavar="BAG", help=common.BAG)
    common.add_config_options(parser)
    common.add_topics(parser)
    parser = common.add_command(commands, "doctor", _doctor, DOCTOR, DOCTOR_EXAMPLES)
    add = parser.add_argument
    text = f"{common.BAG}; without it, what is live"
    add("bag", nargs="?", type=common.named, metavar="BAG", help=text)
    common.add_config_options(parser)
    common.add_topics(parser)
    text = "to listen (default 10)"
    add("--seconds", type=common.positive, default=10.0, metavar="S", help=text)


def _info(options: argparse.Namespace) -> int:
    from quadtree_lss.desk.replay.info import inspect_bag

    config, how = common.chosen_config(options), common.given(options, *common.TOPICS)
    with ProgressBar("info", "s", options.verbose) as bar:
        info = inspect_bag(options.bag, config, **how, progress=bar.update)
    common.tell(options, info)
    if not info.works:
        return common.ERROR
    return common.IN_PART if info.losses else common.DONE


def _doctor(options: argparse.Namespace) -> int:
    from quadtree_lss.desk.replay.info import inspect_bag

    config, how = common.chosen_config(options), common.given(options, *common.TOPICS)
    bag = options.bag
    if bag is None:
        with common.of_ros("doctor without a bag"):
            from quadtree_lss.desk.player.listen import listen
        warn(f"listening for {options.seconds:g} s to what is published now")
        bag = listen(options.seconds)
    else:
        common.refuse(options, "a bag", "seconds")
    with ProgressBar("doctor", "s", options.verbose) as bar:
        info = inspect_bag(bag, config, **how, diagnose=True, progress=bar.update)
    faults = [finding for finding in info.findings if finding.fix or finding.fatal]
    notes = [finding for finding in info.findings if finding not in faults]
    faults.sort(key=lambda finding: not finding.fix)  # the others mostly follow from these
    none = "as above" if faults and faults[0].fix else "none known"
    told = [finding for finding in faults if finding.text != info.verdict]
    lines = [f"fault: {finding.text}\nfix:   {finding.fix or none}" for finding in told]
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
