# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss sites``: landing sites on an elevation model."""

from __future__ import annotations

import argparse
from pathlib import Path

from quadtree_lss.desk.commands import common
from quadtree_lss.desk.commands.console import print_result, warn

TEXT = "Rank landing sites straight on an elevation model: GeoTIFF, or .npz with x, y, elevation."
EXAMPLES = """examples:
  quadtree-lss sites dem.tif                                    (results in results/<time>, latest)
  quadtree-lss sites apollo15.npz --set vehicle.diameter=9 --out apollo
  quadtree-lss sites dem.tif --area='0,0 400,0 400,400 0,400'   (cuts the model to the area)

Results are those of replay; coordinates are the model's, which must be in metres with north up.
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = common.add_command(commands, "sites", _run, TEXT, EXAMPLES)
    add = parser.add_argument
    add("dem", type=common.named, metavar="DEM", help="elevation model, m, z up")
    text = "folder for the results (default results/<time>)"
    add("--out", metavar="DIR", type=common.named, help=text)
    common.add_config_options(parser)
    add("--no-report", action="store_true", help="no figures and no report.html")
    common.add_landing_options(parser, "")


def _run(options: argparse.Namespace) -> int:
    from quadtree_lss.desk.replay.elevation_model import rank_sites
    from quadtree_lss.desk.replay.files import link_latest, new_folder

    out = options.out if options.out is not None else new_folder(Path("results"))
    config, report = common.chosen_config(options), not options.no_report
    result = rank_sites(options.dem, out, config, report=report, landing=common.landing_of(options))
    if options.out is None:
        link_latest(out)
    for line in result.warnings:
        warn(f"note: {line}")
    if options.json:
        common.print_json(result.as_dict())
    else:
        print_result(result)
    return common.DONE
