# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss campaign``."""

from __future__ import annotations

import argparse
from pathlib import Path

from quadtree_lss.desk.commands import common
from quadtree_lss.desk.commands.console import Interruption, ProgressBar, say, warn

TEXT = "Fly a study of many flights on this computer's cores or on a Dask cluster, with resume."
EXAMPLES = """examples:
  quadtree-lss campaign studies/morpheus.yaml --out campaigns/morpheus
  quadtree-lss campaign studies/morpheus.yaml --out campaigns/morpheus     (flies what is missing)
  quadtree-lss campaign studies/morpheus.yaml --out campaigns/morpheus --rerun 17
  quadtree-lss campaign studies/morpheus.yaml --out campaigns/morpheus --keep 17  (bag, page, …)
  quadtree-lss campaign studies/morpheus.yaml --out many --scheduler-address tcp://host:8786

Exit code 3 if some flights failed. Ctrl-C ends it there; what was flown is kept and summed up. A
second one stops at once.
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = common.add_command(commands, "campaign", _run, TEXT, EXAMPLES)
    add = parser.add_argument
    add("study", metavar="STUDY.yaml", help="a study")
    text = "folder of the campaign (default campaigns/STUDY); resumed if it is there"
    add("--out", type=common.path, metavar="DIR", help=text)
    where = parser.add_mutually_exclusive_group()
    text = "processes on this computer (default: one for each core)"
    where.add_argument("--workers", type=common.whole(1), metavar="N", help=text)
    where.add_argument("--scheduler-address", metavar="A", help="of a running Dask scheduler")
    add("--rerun", metavar="LIST", help="fly these again, 17 or 3,8-12, or: failed")
    text = "fly these again and keep all their results in DIR/kept: 17 or 3,8-12"
    add("--keep", metavar="LIST", help=text)


def _run(options: argparse.Namespace) -> int:
    options.out = options.out or Path("campaigns", Path(options.study).stem)
    if options.keep is not None:
        why = "--keep, which flies one after the other here"
        common.reject_options(options, why, "rerun", "workers", "scheduler_address")
    from quadtree_lss.lab.campaign.engine import campaign
    from quadtree_lss.lab.campaign.study import parse_seeds, read_study

    study = read_study(options.study)
    if options.keep is not None:
        kept: dict[str, str] = {}
        for index in parse_seeds(options.keep):
            folder = options.out / "kept" / f"{index:06d}"
            study.kind.keep(study.case(index), folder)
            kept[f"{index}"] = str(folder)
            if not options.json:
                print(f"flight {index} is in {folder}", flush=True)
        if options.json:
            common.print_json({"kept": kept})
        return common.DONE
    rerun = options.rerun or ()
    bar = ProgressBar("campaign", "flights", options.verbose)
    with Interruption(f"sums up in {options.out} what is done") as interruption, bar:
        result = campaign(
            study,
            options.out,
            workers=options.workers,
            scheduler_address=options.scheduler_address,
            rerun=parse_seeds(rerun) if rerun and rerun != "failed" else rerun,
            progress=bar.update,
            stop=interruption.asked,
            tell=warn,
        )
    common.show_result(options, result, f"page and tables in {result.out}")
    if result.interrupted:
        say(f"interrupted: {len(result.records)} of {result.study.count} flights are done")
        return common.INTERRUPTED
    if result.failed:
        warn(f"{len(result.failed)} of {len(result.records)} flights failed")
        return common.IN_PART
    return common.DONE
