# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss info``."""

from __future__ import annotations

import argparse

from quadtree_lss.desk.commands import common
from quadtree_lss.desk.commands.console import ProgressBar

TEXT = "Show what a bag contains and whether it is ready to replay."
EXAMPLES = """examples:
  quadtree-lss info flight_bag
  quadtree-lss info flight_bag --config vehicle.yaml --json

Exit code 1 if it cannot be replayed, for the reasons printed as problems.
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declares the subcommand."""
    parser = common.add_command(commands, "info", _run, TEXT, EXAMPLES)
    add = parser.add_argument
    add("bag", type=common.named, metavar="BAG", help=common.CLOUDS)
    common.add_config_options(parser)
    common.add_topics(parser)


def _run(options: argparse.Namespace) -> int:
    from quadtree_lss.desk.replay.info import inspect_bag

    config = common.chosen_config(options)
    with ProgressBar("info", "s", options.verbose) as bar:
        info = inspect_bag(
            options.bag,
            config,
            scan_topic=options.scan_topic,
            pose_topic=options.pose_topic,
            poses=options.poses,
            progress=bar.update,
        )
    common.tell(options, info)
    if not info.works:
        return common.ERROR
    return common.IN_PART if info.losses else common.DONE
