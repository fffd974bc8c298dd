# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss campaign``: a study of many flights."""

from __future__ import annotations

import argparse

from quadtree_lss.desk.commands import common
from quadtree_lss.desk.commands.console import Interruption, ProgressBar, say, warn

TEXT = "Fly a study of many flights on this computer's cores, with resume."
EXAMPLES = """examples:
  quadtree-lss campaign studies/morpheus.yaml --out campaigns/morpheus
  quadtree-lss campaign studies/morpheus.yaml --out campaigns/morpheus     (flies what is missing)
  quadtree-lss campaign studies/morpheus.yaml --out campaigns/morpheus --rerun 17
  quadtree-lss campaign studies/morpheus.yaml --out campaigns/morpheus --keep 17  (bag, page, …)
  quadtree-lss campaign studies/morpheus.yaml --out campaigns/morpheus --keep worst

Exit code 3 if some flights failed. Ctrl-C ends it there; what was flown is kept and summed up. A
second one stops at once.
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = common.add_command(commands, "campaign", _run, TEXT, EXAMPLES)
    add = parser.add_argument
    add("study", metavar="STUDY.yaml", help="a study")
    text = "folder of the campaign; resumed if it is there"
    add("--out", required=True, type=common.named, metavar="DIR", help=text)
    text = "flights at a time (default: one for each core)"
    add("--workers", type=common.whole(1), metavar="N", help=text)
    add("--rerun", metavar="LIST", help="fly these again, 17 or 3,8-12, or: failed")
    text = "fly these again into DIR/kept, all of it kept: 17 or 3,8-12, or: worst"
    add("--keep", metavar="LIST", help=text)


def _run(options: argparse.Namespace) -> int:
    if options.keep is not None:
        common.refuse(options, "--keep, which flies one after the other", "rerun", "workers")
    from quadtree_lss.lab.campaign.engine import campaign, flagged, keep
    from quadtree_lss.lab.campaign.study import parse_seeds, read_study

    study = read_study(options.study)
    if options.keep is not None:
        kept: dict[str, str] = {}
        worst = options.keep == "worst"
        for index in flagged(options.out) if worst else parse_seeds(options.keep):
            kept[f"{index}"] = str(keep(study, options.out, index))
            if not options.json:
                print(f"flight {index} is in {kept[f'{index}']}", flush=True)
        if options.json:
            common.print_json({"kept": kept})
        return common.DONE
    failed = options.rerun == "failed"
    then = f"sums up in {options.out} what is done"
    verbose = options.verbose
    with Interruption(then) as interruption, ProgressBar("campaign", "flights", verbose) as bar:
        result = campaign(
            study,
            options.out,
            options.workers,
            rerun=parse_seeds(options.rerun) if options.rerun and not failed else (),
            rerun_failed=failed,
            progress=bar.update,
            stop=interruption.asked,
        )
    common.tell(options, result, f"page and tables in {result.out}")
    if result.interrupted:
        say(f"interrupted: {len(result.records)} of {result.study.count} flights are done")
        return common.INTERRUPTED
    if result.failed:
        warn(f"{len(result.failed)} of {len(result.records)} flights failed")
        return common.IN_PART
    return common.DONE
