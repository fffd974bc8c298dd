# SPDX-License-Identifier: Apache-2.0
"""What the page recomputes where a reader moves a slider: the last two steps of a landing pass.

Dispersion, ``lss.max_risk`` and ``lss.margin`` act on the risk of the places, which the page has.
What acts on the risk itself (vehicle, noise, map) needs a new run.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quadtree_lss.desk.exchange.cells import ResultsError, cell_map
from quadtree_lss.desk.report.content import Content
from quadtree_lss.desk.report.pages import Columns
from quadtree_lss.onboard.core.landing.hazards import EXCEPTION
from quadtree_lss.onboard.core.landing.lattice import grown
from quadtree_lss.onboard.core.landing.sites import LandingSiteSelector
from quadtree_lss.onboard.core.landing.target import Restrictions

MOST_POINTS = 100_000
"""Of the finest lattice, for which the page takes a second at most."""


def what_if(content: Content, columns: Columns, stride: int) -> dict[str, Any]:
    """What the sliders go by, ready for JSON; of a run that they do not go with, ``why`` not."""
    config, landing = content.config, content.summary.get("landing") or {}
    lss, domain = config.lss, content.cells["domain"]
    if (lss.assessment, lss.ranking) != ("probability", "probability"):
        return {"why": "only where ground is assessed and sites are ranked by probability"}
    if stride > 1 or (2 ** int(domain[4]) + 1) ** 2 > MOST_POINTS:
        return {"why": "the map is too large for this page"}
    keep_outs = [points for name, points in landing.items() if name.startswith("keep_out")]
    wishes = {name: landing.get(name) for name in ("area", "target")}
    try:
        cells = cell_map("cells.npz", content.cells)
        found = LandingSiteSelector(config).assess(
            cells, keep_outs=keep_outs, dispersion=landing.get("dispersion"), **wishes
        )
    except (ResultsError, ValueError) as error:
        return {"why": str(error)}
    if found.ground is None or not np.array_equal(found.safe, content.grid["safe"]):
        return {"why": "this package finds other ground allowed on this map than the run did"}
    points, side = found.ground[1], cells.domain.finest_size
    extra = np.zeros(found.safe.shape)
    Restrictions(keep_outs=keep_outs, **wishes).apply(extra, found.x, found.y, lss)
    if found.shadow is not None:
        extra += lss.weight_shadow * found.shadow
    excepted = grown(points.hazard & EXCEPTION > 0, 0.5 * lss.vehicle.diameter, side)
    bound = bool(keep_outs) or wishes["area"] is not None
    return {
        "run": "sites" if content.summary.get("posts") else "replay",
        "bag": content.summary["bag"],
        "n": cells.domain.finest_count + 1,
        "side": side,
        "risk": columns.floats(points.risk),
        "room": columns.floats(np.minimum(points.around.room, 1e6)),
        "judged": columns.whole(points.around.judged, "u1"),
        "excepted": columns.whole(excepted, "u1"),
        "score": columns.quantised(points.score),
        "extra": columns.floats(extra),
        "diameter": lss.vehicle.diameter,
        "number": lss.sites,
        "separation": lss.separation,
        "dispersion": content.dispersion,
        "max_risk": lss.max_risk,
        "margin": None if bound else lss.margin,
        "own_margin": lss.margin,
    }
