# SPDX-License-Identifier: Apache-2.0
"""Limits of memory and time: parameters that exceed them are rejected.

The coefficients were measured on two shared x86-64 cores with worst-case ground
(``docs/onboard.md``); most maps take a tenth of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quadtree_lss.onboard.config.sections import LssConfig

MAX_ASSESSMENT_S = 60.0
"""Longest worst-case time of an assessment, s."""
MAX_MEMORY_BYTES = 2.0e9
"""Largest memory of an assessment, bytes."""
MAX_LEVEL = 11
"""Largest level of the finest cells."""
MAX_LEAVES = 1_000_000
"""Largest number of leaves; each takes up to 1.5 kB while it is updated, copied and sent."""
STEP_LEVEL = 5
"""A domain that follows moves by cells of this level, or by coarsest cells if these are larger, so
that moves are rare."""

MIN_CELL_SIZE = 1e-3
"""Smallest size of the finest cells, m; no lidar is more precise."""
MAX_GRID_POINTS = 4096
"""Largest number of grid points along a side of the domain."""
YAWS = 12
"""Headings at which contact is evaluated, 7.5 degrees apart for four pads. 6, 12 and 24 headings
find 99.82, 99.87 and 99.89 % of simulated hazards (Morpheus seeds 101-106, touchdown check)."""


def exceeded_limit(size: float, finest: int, lss: LssConfig) -> str | None:
    """Return the limit that an assessment exceeds, or None; ``size``: side of the domain, m;
    ``finest``: number of finest cells along a side."""
    if size / finest < MIN_CELL_SIZE:
        return f"the finest cells are {size / finest:.3g} m wide; {MIN_CELL_SIZE:g} is the least"
    points = size / lss.spacing
    if points > MAX_GRID_POINTS:
        return (
            f"lss.grid_spacing = {lss.spacing:g} m makes {points:.0f} grid points a side over"
            f" {size:g} m; {MAX_GRID_POINTS} is the most"
        )
    memory = 300.0 * finest**2 + 60.0 * points**2
    if finest > 1 << MAX_LEVEL or memory > MAX_MEMORY_BYTES:
        return (
            f"{finest} finest cells and {points:.0f} grid points a side take"
            f" {1e-9 * memory:.1f} GB for an assessment; {1e-9 * MAX_MEMORY_BYTES:.1f} is the most"
        )
    seconds = assessment_seconds(size, finest, lss)
    if seconds > MAX_ASSESSMENT_S:
        return (
            f"vehicle.diameter = {lss.vehicle.diameter:g} m, lss.margin = {lss.margin:g} m and"
            f" lss.sites = {lss.sites} on {finest} finest cells of {size / finest:.3g} m a side may"
            f" take {seconds:.0f} s for an assessment; {MAX_ASSESSMENT_S:g} is the most"
        )
    return None


def assessment_seconds(size: float, finest: int, lss: LssConfig) -> float:
    """Return the worst-case time of an assessment, s; arguments as for `exceeded_limit`."""
    # A zone larger than the domain costs as much as one that fills it; no contact is computed for
    # a vehicle larger than the domain.
    side, radius = size / finest, 0.5 * lss.vehicle.diameter
    lander = min(radius / side, 0.5 * finest)
    zone = min((radius + lss.margin) / side, 0.5 * finest)
    each = 600.0 + 6.0 * lander + 3.0 * zone + 10.0 * lss.sites
    if lss.assessment != "paper" and lss.vehicle.diameter <= size:
        each += YAWS * (25.0 + 5.0 * lander**2)
    ranking = 5.0 * lss.sites * (size / lss.spacing) ** 2
    return 1e-9 * (each * finest**2 + ranking)
