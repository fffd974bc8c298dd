# SPDX-License-Identifier: Apache-2.0
"""What ``report.html`` embeds: the map and its assessment as quantised columns in base64."""

from __future__ import annotations

import base64
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.config.settings import Config
from quadtree_lss.core.geometry.feature import peak
from quadtree_lss.core.landing.hazards import slope
from quadtree_lss.core.landing.sites import LandingAssessment
from quadtree_lss.core.tree.cell_map import CellMap
from quadtree_lss.report.figures import (
    CLEAR_COLOUR,
    EXCLUDED_COLOUR,
    HAZARDS,
    SAFE_COLOUR,
    SITE_COLOUR,
    colour_limits,
    colour_table,
    hazard_note,
)

if TYPE_CHECKING:
    from quadtree_lss.replay.result import ReplayResult

MAX_GRID_POINTS = 250_000
"""Of the landing grid that are embedded; of larger grids every other, third, … point is."""
MAX_LEAVES = 80_000
"""With hover values; beyond, only the outlines of the leaves are embedded."""

_NONE = {"u1": 0xFF, "u2": 0xFFFF}


def page_data(result: ReplayResult, config: Config) -> dict[str, Any]:
    """Everything the page's script draws, ready for JSON."""
    assessment = result.assessment
    return {
        "grid": _grid(assessment, config),
        "leaves": _leaves(result.cells),
        "sites": _sites(assessment),
        "zone": 0.5 * config.lss.vehicle_diameter + config.lss.margin,
        "timing": _timing(result),
        "hazards": [{"bit": b, "name": name, "colour": c} for b, name, c in HAZARDS],
        "hazard_note": hazard_note(config),
        "colours": {
            "clear": CLEAR_COLOUR,
            "excluded": EXCLUDED_COLOUR,
            "safe": SAFE_COLOUR,
            "site": SITE_COLOUR,
            **{name: _base64(colour_table(name)) for name in ("viridis", "cividis", "magma")},
        },
    }


def quantised(values: NDArray[Any], kind: str = "u2") -> dict[str, Any]:
    """A column whose entry i is low + step · data[i]; the greatest number stands for NaN."""
    flat = np.asarray(values, dtype=np.float64).ravel()
    finite = np.isfinite(flat)
    low, high = (flat[finite].min(), flat[finite].max()) if finite.any() else (0.0, 0.0)
    top = _NONE[kind] - 1
    step = float(high - low) / top if high > low else 1.0
    data = np.full(flat.shape, _NONE[kind], dtype=f"<{kind}")
    data[finite] = np.rint((flat[finite] - low) / step)
    return {"kind": kind, "low": float(low), "step": step, "data": _base64(data)}


def whole_numbers(values: NDArray[Any], kind: str) -> dict[str, Any]:
    """A column of integers as they are, kind ``u1``, ``u2`` or ``u4``."""
    return {"kind": kind, "data": _base64(np.ascontiguousarray(values).astype(f"<{kind}"))}


def _base64(values: NDArray[Any]) -> str:
    return base64.b64encode(values.tobytes()).decode()


def _grid(assessment: LandingAssessment, config: Config) -> dict[str, Any]:
    stride = int(np.ceil(np.sqrt(max(assessment.hazard.size / MAX_GRID_POINTS, 1.0))))
    x, y = assessment.x[::stride], assessment.y[::stride]

    def part(values: NDArray[Any]) -> NDArray[Any]:
        return values[::stride, ::stride]

    limit = config.lss.max_slope_deg
    return {
        "nx": len(x),
        "ny": len(y),
        "xmin": float(x[0]),
        "ymin": float(y[0]),
        "spacing": float(x[1] - x[0]) if len(x) > 1 else config.lss.grid_spacing,
        "stride": stride,
        "elevation": quantised(part(assessment.elevation))
        | {"limits": colour_limits(assessment.elevation)},
        "slope": quantised(part(assessment.slope_deg))
        | {"limits": (0.0, 2.0 * limit), "mark": limit},
        "score": quantised(part(assessment.score)) | {"limits": colour_limits(assessment.score)},
        "hazard": whole_numbers(part(assessment.hazard), "u1"),
        "safe": whole_numbers(part(assessment.safe), "u1"),
    }


def _leaves(cells: CellMap) -> dict[str, Any]:
    domain = cells.domain
    columns: dict[str, Any] = {
        "level": whole_numbers(cells.level, "u1"),
        "ix": whole_numbers(cells.ix, "u2"),
        "iy": whole_numbers(cells.iy, "u2"),
    }
    if len(cells.level) <= MAX_LEAVES:
        with np.errstate(invalid="ignore"):
            sigma = np.where(cells.estimated, np.sqrt(cells.covariance[:, 2, 2]), np.nan)
            degrees = np.where(cells.estimated, np.degrees(slope(cells.normal)), np.nan)
        rough = cells.roughness / cells.size**2  # Eq. 55 by area: distance from the plane
        shown = np.isfinite(cells.feature[:, 0])
        height = np.full(len(cells.level), np.nan)
        height[shown] = peak(cells.feature[shown])
        columns |= {
            "z": quantised(cells.z),
            "slope": quantised(degrees),
            "sigma": quantised(sigma) | {"limits": colour_limits(sigma)},
            "roughness": quantised(rough) | {"limits": colour_limits(rough)},
            "exceptions": quantised(cells.exception_fraction, "u1"),
            "feature": quantised(height),
            "count": whole_numbers(cells.count, "u4"),
            "measured": whole_numbers(cells.measured, "u1"),
        }
    return {
        "number": len(cells.level),
        "xmin": domain.xmin,
        "ymin": domain.ymin,
        "size": domain.size,
        "min_level": domain.min_level,
        "max_level": domain.max_level,
        **columns,
    }


def _sites(assessment: LandingAssessment) -> list[dict[str, Any]]:
    sites = assessment.sites
    return [
        {"rank": k + 1, "x": float(x), "y": float(y), "z": float(z)}
        for k, (x, y, z) in enumerate(sites.position)
    ]


def _timing(result: ReplayResult) -> dict[str, Any]:
    rows = result.timings
    first = rows[0].stamp_ns if rows else 0
    return {
        "seconds": [round((row.stamp_ns - first) / 1e9, 4) for row in rows],
        "map_ms": [round(row.map_ms, 3) for row in rows],
        "leaves": [row.leaves for row in rows],
        "used": [row.points_used for row in rows],
        "points": [row.points for row in rows],
    }
