# SPDX-License-Identifier: Apache-2.0
"""Colours of the page and the figures; classes use the palette of Okabe and Ito."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.arrays import Array, Bytes
from quadtree_lss.onboard.core.landing.hazards import PARTLY_UNOBSERVED, UNMAPPED, UNSEEN

UNSEEN_COLOUR = "#c3d4ee"
UNMAPPED_NAME, UNMAPPED_COLOUR = "observed but not estimated", "#8c8ca6"
PARTLY_NAME, PARTLY_COLOUR = "unobserved ground under the vehicle", "#9db1cc"
UNKNOWN = UNSEEN | UNMAPPED
# Bit, name and colour of each hazard; a grid point is drawn with the first one that applies.
HAZARDS = (
    (UNMAPPED, UNMAPPED_NAME, UNMAPPED_COLOUR),
    (UNSEEN, "unobserved", UNSEEN_COLOUR),
    (PARTLY_UNOBSERVED, PARTLY_NAME, PARTLY_COLOUR),
    (8, "touchdown", "#e69f00"),
    (4, "exception", "#56b4e9"),
    (1, "slope", "#d55e00"),
    (2, "elevation", "#cc79a7"),
)
CLEAR_COLOUR = "#f0e9c8"  # no hazard
SAFE_COLOUR, EXCLUDED_COLOUR = "#009e73", "#882255"
SITE_COLOUR = "#1c1c1c"
#: Colour maps of matplotlib by kind of layer; bright colours are favourable.
MAPS = {
    "elevation": "cividis",
    "slope": "viridis_r",
    "score": "viridis_r",
    "probability": "viridis",
    "deviation": "magma_r",
    "error": "RdBu_r",
}
#: Kinds of the layers whose name is not a kind.
KINDS = {
    "plane_elevation": "elevation",
    "map_height": "elevation",
    "slope_deg": "slope",
    "map_deviation": "deviation",
    "risk": "score",
}
#: Lower end of the logarithmic scale of risks, which ends at 1.
MIN_SHOWN_RISK = 1e-4


def excluding(assessment: str) -> int:
    """Bits of the hazards that exclude landing."""
    return PARTLY_UNOBSERVED | (4 | 2 | 1 if assessment == "paper" else 8)


def hazard_classes(bits: Bytes, hazards: Sequence[tuple[int, str, str]]) -> NDArray[np.int64]:
    """Number of the first of ``hazards`` that applies to each grid point, from 1; 0 if none."""
    kind = np.zeros(bits.shape, dtype=np.int64)
    for number, (bit, _, _) in reversed(list(enumerate(hazards, start=1))):
        kind[(bits & bit) > 0] = number
    return kind


def colour_limits(values: Array) -> tuple[float, float]:
    """Range of a colour map: the 1st and 99th percentiles."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = np.percentile(finite, [1.0, 99.0])
    return float(low), float(high) if high > low else float(low) + 1e-6


def top_limit(values: Array) -> tuple[float, float]:
    """Range from 0 to the 99th percentile."""
    return 0.0, max(colour_limits(values)[1], 1e-6)


def even_limits(values: Array) -> tuple[float, float]:
    """Range symmetric about 0, up to the 99th percentile of the absolute values."""
    top = top_limit(np.abs(values))[1]
    return -top, top


def shaded(image: Array, elevation: Array, spacing: float, strength: float = 0.75) -> Array:
    """Shade colours (ny, nx, 3) in 0 … 1 by a light from the north-west, with slopes exaggerated as
    on the page; level and unknown ground keeps its colours."""
    single = min(elevation.shape) < 2
    along_y, along_x = [0.0 * elevation] * 2 if single else np.gradient(elevation, spacing)
    slopes = np.hypot(along_x, along_y)
    steep = np.nanpercentile(slopes, 90) if np.isfinite(slopes).any() else 0.0
    factor = np.clip(0.6 / max(steep, 1e-9), 0.5, 6.0)
    a, b = factor * along_x, factor * along_y
    lit = np.nan_to_num((1.0 + np.sqrt(0.5) * (a - b)) / np.hypot(np.hypot(a, b), 1.0), nan=1.0)
    grey = np.where(lit < 1.0, 0.5 * np.maximum(lit, 0.0), 0.5 + 0.4 * (lit - 1.0) / 0.41421)
    grey = grey[..., None]
    # Blend mode "hard light".
    dark, bright = 2.0 * image * grey, 1.0 - 2.0 * (1.0 - image) * (1.0 - grey)
    result: Array = np.clip(image + strength * (np.where(grey < 0.5, dark, bright) - image), 0, 1)
    return result
