# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss info``."""

from __future__ import annotations

import argparse

from quadtree_lss.desk.commands.common import (
    CLOUDS,
    DONE,
    ERROR,
    IN_PART,
    add_command,
    add_config_options,
    add_topics,
    chosen_config,
    named,
    tell,
)
from quadtree_lss.desk.commands.console import ProgressBar

TEXT = "Show what a bag contains and whether it is ready to replay."
EXAMPLES = """examples:
  quadtree-lss info flight_bag
  quadtree-lss info flight_bag --config vehicle.yaml --json

Exit code 1 if it cannot be replayed, for the reasons printed as problems.
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declares the subcommand."""
    parser = add_command(commands, "info", _run, TEXT, EXAMPLES)
    add = parser.add_argument
    add("bag", type=named, metavar="BAG", help=CLOUDS)
    add_config_options(parser)
    add_topics(parser)


def _run(options: argparse.Namespace) -> int:
    from quadtree_lss.desk.replay.info import inspect_bag

    config = chosen_config(options)
    with ProgressBar("info", "s", options.verbose) as bar:
        info = inspect_bag(
            options.bag,
            config,
            scan_topic=options.scan_topic,
            pose_topic=options.pose_topic,
            poses=options.poses,
            progress=bar.update,
        )
    tell(options, info)
    if not info.works:
        return ERROR
    return IN_PART if info.losses else DONE
