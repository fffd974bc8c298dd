# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss evaluate``, ``fit-risk`` and ``campaign``."""

from __future__ import annotations

import argparse
from pathlib import Path

from quadtree_lss.desk.commands import common
from quadtree_lss.desk.commands.console import interruption, progress_bar, say, warn

EVALUATE = "Score results of a replay against the truth of a simulation."
EVALUATE_EXAMPLES = """examples:
  quadtree-lss evaluate results/latest --truth flight/truth.npz

Many flights at once: quadtree-lss campaign.
"""
FIT = "Fit the probability of a safe touchdown for another lander or lidar (lss.risk_model)."
FIT_EXAMPLES = """examples:
  quadtree-lss fit-risk --out mine.yaml --set lidar.range_noise=0.1
  quadtree-lss fit-risk --out mine.yaml --families whole,mixed,bare --seeds 1-30
  quadtree-lss replay BAG --set lss.risk_model=mine.yaml

It flies over simulated ground and takes truth from the simulation alone. Families that vary neither
vehicle nor noise nor cells have those of the configuration (default: morpheus). Seeds are dealt to
the families in turn, a flight each, about 2 s.
"""
DEFAULT_SEEDS = "90000-90219"
CAMPAIGN = "Fly a study of many flights on this computer's cores or on a Dask cluster, with resume."
CAMPAIGN_EXAMPLES = """examples:
  quadtree-lss campaign studies/morpheus.yaml --out campaigns/morpheus
  quadtree-lss campaign studies/morpheus.yaml --out campaigns/morpheus     (flies what is missing)
  quadtree-lss campaign studies/morpheus.yaml --out campaigns/morpheus --rerun 17
  quadtree-lss campaign studies/morpheus.yaml --out campaigns/morpheus --keep 17  (bag, page, …)
  quadtree-lss campaign studies/morpheus.yaml --out many --scheduler-address tcp://host:8786

Exit code 3 if some flights failed. Ctrl-C ends it there; what was flown is kept and summed up. A
second one stops at once.
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = common.add_command(commands, "evaluate", _evaluate, EVALUATE, EVALUATE_EXAMPLES)
    add = parser.add_argument
    add("results", type=common.path, metavar="DIR", help="folder that replay wrote")
    text = "truth.npz of the simulation"
    add("--truth", required=True, type=common.path, metavar="NPZ", help=text)
    text = "folder for scores and page (default DIR/evaluation)"
    add("--out", type=common.path, metavar="DIR", help=text)
    parser = common.add_command(commands, "fit-risk", _fit, FIT, FIT_EXAMPLES)
    add = parser.add_argument
    text = "file to write (default risk_model.yaml)"
    add("--out", type=common.path, default=Path("risk_model.yaml"), metavar="YAML", help=text)
    text = f"of the flights (default {DEFAULT_SEEDS})"
    add("--seeds", default=DEFAULT_SEEDS, metavar="LIST", help=text)
    add("--families", metavar="LIST", help="of flights, of those that the docs list (all)")
    common.add_config_options(parser)
    add("--overwrite", action="store_true", help="replace an existing file")
    parser = common.add_command(commands, "campaign", _campaign, CAMPAIGN, CAMPAIGN_EXAMPLES)
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


def _evaluate(options: argparse.Namespace) -> int:
    from quadtree_lss.lab.evaluation.evaluate import evaluate

    result = evaluate(options.results, options.truth, options.out)
    common.show_result(options, result, f"page and numbers in {result.out}")
    return common.DONE


def _fit(options: argparse.Namespace) -> int:
    from quadtree_lss.desk.replay.files import made, write_bytes
    from quadtree_lss.desk.replay.results import aligned
    from quadtree_lss.lab.campaign.study import parse_seeds
    from quadtree_lss.lab.evaluation.results import EvaluationError
    from quadtree_lss.lab.evaluation.risk_families import FAMILIES
    from quadtree_lss.lab.evaluation.risk_fit import risk_model_text
    from quadtree_lss.lab.evaluation.risk_flights import fit_risk

    out: Path = options.out
    if out.is_dir() or (out.exists() and not options.overwrite):
        why = "is a folder" if out.is_dir() else "exists; --overwrite replaces it"
        options.parser.error(f"{out} {why}")
    options.config = options.config or ["morpheus"]
    config = common.chosen_config(options)
    families = options.families.split(",") if options.families else tuple(FAMILIES)
    seeds = parse_seeds(options.seeds)
    bar = progress_bar("fit-risk", "flights", options.verbose)
    with made(out.parent, EvaluationError), bar as update:
        model = fit_risk(config, seeds, families, update)
        write_bytes(out, risk_model_text(model).encode())
    origin = model.provenance
    rows = [("family", "flights", "points", "failed", "Brier", "log")]
    for name, case in origin["families"].items():
        share, log = f"{100.0 * case['failed']:.1f} %", f"{case['log_score']:.5f}"
        count, points = str(len(case["seeds"])), str(case["points"])
        rows.append((name, count, points, share, f"{case['brier']:.5f}", log))
    text = "\n".join([*aligned(rows), f"the fit is in {out}"])
    common.show(options, {"out": str(out), **origin}, text)
    return common.DONE


def _campaign(options: argparse.Namespace) -> int:
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
            print(common.json_text({"kept": kept}))
        return common.DONE
    rerun = options.rerun or ()
    bar = progress_bar("campaign", "flights", options.verbose)
    with interruption(f"sums up in {options.out} what is done") as interrupted, bar as update:
        result = campaign(
            study,
            options.out,
            workers=options.workers,
            scheduler_address=options.scheduler_address,
            rerun=parse_seeds(rerun) if rerun and rerun != "failed" else rerun,
            progress=update,
            stop=interrupted,
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
