# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss doctor``."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from quadtree_lss.desk.commands import common
from quadtree_lss.desk.commands.console import ProgressBar, show

TEXT = "Say what is wrong with clouds and poses, live or in a bag, and the line that mends it."
EXAMPLES = """examples:
  quadtree-lss doctor --config vehicle.yaml             (the topics that are live now, ten seconds)
  quadtree-lss doctor flight_bag --config vehicle.yaml

Frames, axes, units, quaternions, clocks, lag, mount, rates and covariances. Move the vehicle
meanwhile: what does not change cannot be told apart. Exit code 1 if something is wrong.
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declares the subcommand."""
    parser = common.add_command(commands, "doctor", _run, TEXT, EXAMPLES)
    add = parser.add_argument
    add("bag", nargs="?", type=common.named, metavar="BAG", help="a bag; without, what is live")
    common.add_config_options(parser)
    common.add_topics(parser, poses=False)
    add("--seconds", type=float, default=10.0, metavar="S", help="to listen (default 10)")


def _run(options: argparse.Namespace) -> int:
    from quadtree_lss.desk.replay.info import inspect_bag

    config = common.chosen_config(options)
    with tempfile.TemporaryDirectory() as folder:
        bag = options.bag
        if bag is None:
            from quadtree_lss.desk.player.listen import record_live

            bag = record_live(Path(folder) / "live", options.seconds)
        with ProgressBar("doctor", "s", options.verbose) as bar:
            info = inspect_bag(
                bag,
                config,
                scan_topic=options.scan_topic,
                pose_topic=options.pose_topic,
                progress=bar.update,
            )
    wrong = [finding for finding in info.findings if finding.mend or finding.fatal]
    if options.json:
        common.print_json({"findings": [finding._asdict() for finding in wrong]})
    else:
        for finding in wrong:
            show(f"wrong: {finding.text}\nmend:  {finding.mend or 'none known'}")
        if not wrong:
            show(f"nothing is wrong with {info.scan_topic or 'the maps'} and {info.pose_topic}")
    return common.ERROR if wrong else common.DONE
