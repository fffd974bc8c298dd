# SPDX-License-Identifier: Apache-2.0
"""What the page recomputes where a reader moves a slider: the last two steps of a landing pass.

Dispersion, ``lss.max_risk`` and ``lss.margin`` act on the risk of the places, which the page has.
Another vehicle rests in another way on the ground: of some diameters and clearances the passes are
made with the page. Noise and map need a new run, and so does all else of the vehicle.
"""

from __future__ import annotations

import shlex
from itertools import product
from typing import Any

import numpy as np

from quadtree_lss.desk.exchange.saved import Results
from quadtree_lss.desk.report.pages import Columns
from quadtree_lss.onboard.config.risk import doubt
from quadtree_lss.onboard.config.settings import Config, ConfigError, config_from_values
from quadtree_lss.onboard.core.landing.assessment import LandingAssessment
from quadtree_lss.onboard.core.landing.hazards import EXCEPTION
from quadtree_lss.onboard.core.landing.lattice import grown
from quadtree_lss.onboard.core.landing.sites import LandingSiteSelector
from quadtree_lss.onboard.core.landing.target import Restrictions

MOST_POINTS = 100_000
"""Of the finest lattice, for which the page takes a second at most."""
TRIED = 0.75, 1.0, 1.5
"""Diameters and clearances of the vehicles that are tried, over those of the run's."""
SMALL, STEP = 0.01, 0.01
"""The risk of another vehicle is told in steps of log10(risk + SMALL): to 1.2 % of that sum."""


def what_if(content: Results, columns: Columns, stride: int) -> dict[str, Any]:
    """What the sliders go by, ready for JSON; of a run that they do not go with, ``why`` not."""
    config, landing = content.config, content.summary.get("landing") or {}
    lss, cells = config.lss, content.map
    if (lss.assessment, lss.ranking) != ("probability", "probability"):
        return {"why": "only where ground is assessed and sites are ranked by probability"}
    if stride > 1 or (cells.domain.finest_count + 1) ** 2 > MOST_POINTS:
        return {"why": "the map is too large for this page"}
    keep_outs = [points for name, points in landing.items() if name.startswith("keep_out")]
    wishes = {name: landing.get(name) for name in ("area", "target")} | {"keep_outs": keep_outs}
    told = {**wishes, "dispersion": landing.get("dispersion")}
    try:
        found = LandingSiteSelector(config).assess(cells, **told)
    except ValueError as error:
        return {"why": str(error)}
    if found.ground is None or not np.array_equal(found.safe, content.grid["safe"]):
        return {"why": "this package finds other ground allowed on this map than the run did"}
    at, ground = found.ground
    vehicles = [_vehicle(found, config, wishes, columns) | {"risk": columns.floats(ground.risk)}]
    for wide, high in product(TRIED, TRIED):
        values = {
            "vehicle.diameter": wide * config.vehicle.diameter,
            "vehicle.clearance": high * config.vehicle.clearance,
            "lss.grid_spacing": lss.spacing,
        }
        try:
            other = config_from_values(values, config)
        except ConfigError:  # it is no vehicle
            continue
        if wide != 1.0 or high != 1.0:
            tried = LandingSiteSelector(other).assess(cells, **told)
            assert tried.ground is not None  # as of the run
            risk = STEP * np.rint(np.log10(tried.ground[1].risk + SMALL) / STEP)
            risk_of = {"about": columns.quantised(risk, least=0.5 * STEP)}
            vehicles.append(_vehicle(tried, other, wishes, columns) | risk_of)
    judged, score = at.everywhere(ground.around.judged), at.nearest(ground.score)
    unscored = judged & np.isnan(content.grid["score"])
    bound = bool(keep_outs) or wishes["area"] is not None
    return {
        "run": "sites" if content.summary.get("posts") else "replay",
        "bag": shlex.quote(content.summary["bag"]),
        "n": cells.domain.finest_count + 1,
        "side": cells.domain.finest_size,
        "vehicles": vehicles,
        "small": SMALL,
        "score": columns.quantised(np.where(unscored, score, np.nan)),
        "number": lss.sites,
        "dispersion": content.dispersion,
        "max_risk": lss.max_risk,
        "margin": None if bound else lss.margin,
        "own_margin": lss.margin,
    }


def _vehicle(
    found: LandingAssessment, config: Config, wishes: dict[str, Any], columns: Columns
) -> dict[str, Any]:
    """What a vehicle meets on the ground, before dispersion, risk and margin have a say."""
    assert found.ground is not None  # the map has ground
    (_, points), lss = found.ground, config.lss
    judged = points.around.judged
    extra = np.zeros(found.safe.shape)
    Restrictions(**wishes).apply(extra, found.x, found.y, lss)
    side = points.raster.domain.finest_size
    excepted = grown(points.hazard & EXCEPTION > 0, 0.5 * lss.vehicle.diameter, side)
    return {
        "diameter": lss.vehicle.diameter,
        "clearance": lss.vehicle.clearance,
        "separation": lss.vehicle.lengths.min_separation,
        "doubt": doubt(config),
        "room": columns.floats(np.where(judged, np.minimum(points.around.room, 1e6), 0.0)),
        "judged": columns.whole(judged, "u1"),
        "excepted": columns.whole(excepted, "u1"),
        "extra": columns.floats(extra),
    }
