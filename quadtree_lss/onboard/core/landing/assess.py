# SPDX-License-Identifier: Apache-2.0
"""Assessment of landing sites on a map (paper V), in five steps:

1. ``raster``: map -> terrain on the finest cells and about their corners, the grid points
2. ``contact``: per grid point -> rise and tilt of the vehicle, over all headings
3. ``risk``, ``score``: per grid point -> predicted risk of a touchdown there, hazards and score
4. ``aim``: user's grid -> probability of success with the touchdown dispersion, and restrictions
5. ``choose``: user's grid -> ranked sites with reasons, and the target
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Bytes, keep_memory
from quadtree_lss.onboard.config.risk import risk_model
from quadtree_lss.onboard.config.settings import DEFAULTS, Config
from quadtree_lss.onboard.core.landing.aim import Dispersion, aim, make_grid
from quadtree_lss.onboard.core.landing.choose import choose
from quadtree_lss.onboard.core.landing.contact import ContactCheck, touchdown_limits
from quadtree_lss.onboard.core.landing.hazards import UNSEEN
from quadtree_lss.onboard.core.landing.lattice import corner_bits
from quadtree_lss.onboard.core.landing.ranking import Candidates
from quadtree_lss.onboard.core.landing.raster import rasterise
from quadtree_lss.onboard.core.landing.restrictions import Restrictions
from quadtree_lss.onboard.core.landing.result import LandingAssessment, no_target
from quadtree_lss.onboard.core.landing.risk import RiskTable, contact_limits
from quadtree_lss.onboard.core.landing.score import assess_points
from quadtree_lss.onboard.core.landing.target import Motion, Reason, Situation, TargetKeeper
from quadtree_lss.onboard.core.tree.cell_map import CellMap


class LandingSiteSelector:
    """Assesses successive maps.

    Keeps the target (`target.TargetKeeper`), and the contacts, which are recomputed only where the
    ground changed.
    """

    def __init__(self, config: Config = DEFAULTS) -> None:
        self._keeper = TargetKeeper()
        keep_memory()
        self.configure(config)

    def configure(self, config: Config) -> None:
        """Use another configuration, and discard the contacts."""
        self.config, lss = config, config.lss
        self._risk_table: RiskTable | None = None
        self._contact_check: ContactCheck | None = None
        if lss.ranking == "probability":
            model = risk_model(lss.risk_model)
            self._risk_table = RiskTable(model, lss, config.lidar.range_noise)
            self._contact_check = ContactCheck(lss, contact_limits(model, lss))
        elif lss.assessment == "touchdown":
            self._contact_check = ContactCheck(lss, touchdown_limits(lss))

    def release(self) -> None:
        """Drop the target: the next assessment chooses as if there were none."""
        self._keeper.release()

    def land_now(self) -> None:
        """Make the best grid point within reach the target until `release`."""
        self._keeper.land_now()

    def assess(
        self,
        cells: CellMap,
        *,
        area: ArrayLike | None = None,
        keep_outs: Sequence[ArrayLike] = (),
        target: ArrayLike | None = None,
        dispersion: ArrayLike | None = None,
        why_withheld: str = "",
        vehicle: Sequence[float] | None = None,
        waited: float = inf,
    ) -> LandingAssessment:
        """Rank landing sites on a map, and choose the target.

        Args:
            cells: The map.
            area, keep_outs, target: Where landing is wanted (`Restrictions`).
            why_withheld: If not empty, no site is given out, for this reason.
            dispersion: Standard deviations of the touchdown about its aim point along x and y, m,
                and optionally the vehicle's heading, rad, NaN for any; None for ``lss.dispersion``
                and any heading. A risk model was fitted to the worst heading and ignores it.
            vehicle: As of `Motion`: height and downward speed, and optionally position and
                velocity; None if unknown.
            waited: Time since the first map, s. After ``lss.settle_time`` a target is chosen even
                if little of the landing area is observed.

        Raises:
            ValueError: The dispersion or a restriction is invalid.
        """
        lss, keeper = self.config.lss, self._keeper
        spread = Dispersion.from_values(dispersion, lss)
        restrictions = Restrictions(area, keep_outs, target, why_withheld).checked()
        keeper.apply_restrictions(restrictions, lss)

        raster = rasterise(cells, lss)
        if not raster.observed.any():
            reason = Reason.WITHHELD if why_withheld else Reason.NOTHING_MAPPED
            return self._nothing(cells, reason, raster.unknown_bits)
        contacts = None  # the paper's rules need none
        if self._contact_check is not None:
            heading = None if self._risk_table is not None else spread.heading
            contacts = self._contact_check.contacts(raster, raster.needs_contact, heading)
        points = assess_points(raster, contacts, self._risk_table, lss)
        motion = None
        if vehicle is not None:  # its height is ``offset_z`` too large over the map
            height, *others = vehicle
            motion = Motion(height - np.nan_to_num(cells.offset_z), *others)
        aims = aim(points, spread, restrictions, motion, keeper.held, lss)
        return choose(points, aims, keeper, waited, self.config)

    def withhold(self, cells: CellMap, why: str) -> LandingAssessment:
        """Return neither site nor target, because the assessment of a map failed."""
        self.configure(self.config)  # contacts may be incomplete
        unseen = np.full((cells.domain.finest_count,) * 2, UNSEEN, dtype=np.uint8)
        nothing = self._nothing(cells, Reason.WITHHELD, unseen)
        return replace(nothing, explanation=f"no site is given out: {why}")

    def _nothing(self, cells: CellMap, reason: Reason, bits: Bytes) -> LandingAssessment:
        """Return an assessment without site and target; ``bits``: hazards (n, n)."""
        lss, grid = self.config.lss, make_grid(cells.domain, self.config.lss.spacing)
        shape = (len(grid.y), len(grid.x))
        unknown, nowhere = np.full(shape, np.nan), np.zeros(shape, dtype=np.bool_)
        ground = Candidates(grid.x, grid.y, nowhere, unknown, np.ones(shape))
        self._keeper.choose(Situation(ground, lss, lambda *_: reason, reason))
        return LandingAssessment(
            stamp_ns=cells.stamp_ns,
            number=self._keeper.assessments,
            selected=no_target(reason),
            x=grid.x,
            y=grid.y,
            hazard=grid.any(corner_bits(bits)),
            safe=nowhere,
            score=unknown,
            probability=np.zeros(shape),
            risk=ground.risk,
            offset_z=cells.offset_z,
            offset_variance=cells.offset_variance,
            lss=lss,
        )
