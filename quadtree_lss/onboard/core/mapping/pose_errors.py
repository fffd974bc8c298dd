# SPDX-License-Identifier: Apache-2.0
"""Whether poses err as they claim: seen in how scans lie over the map, over several of them."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

#: Steps from scan to scan that are looked back at, and that it takes to say something.
STEPS, LEAST = 60, 20
#: Median of chi^2 of one degree of freedom.
MEDIAN = 0.45494
#: Steps of errors that are all news may be so much smaller than claimed: claims are cautious, and
#: of a bias nothing is seen.
CAUTIOUS = 4.0
#: Share of the claimed variance that must be seen to be white before it is said.
WHITE_SHARE = 0.25
#: Correlation from scan to scan below which errors are claimed to be news.
NEWS = 0.5


@dataclass(frozen=True)
class PoseErrors:
    """How far poses' heights err, as seen and as claimed.

    Attributes:
        seen, claimed: Deviation of the white errors that make the steps which were seen, and as
            poses and ``pose.correlation_time`` claim it, m.
        size: Deviation of a scan's height as its pose claims it, m.
        map_says, white_says: Deviation of the map's height from pose error as it is claimed; of
            white errors, or of errors that persist where they are claimed to be white, m.
        white: Errors claimed to persist look white.
        persist: Errors claimed to be white look as if they persisted.
        too_small: Errors look larger than the poses' covariances.
    """

    seen: float
    claimed: float
    size: float
    map_says: float
    white_says: float
    white: bool
    persist: bool
    too_small: bool


@dataclass
class Steps:
    """How scans lay over the map, one after the other: the last `STEPS` of them."""

    rows: deque[tuple[float, ...]] = field(default_factory=lambda: deque(maxlen=STEPS))
    _last: tuple[float, float, float] | None = None

    def add(
        self,
        time: float,
        height: float,
        claimed: float,
        mapped: float,
        noise: float,
        since: float,
        correlation_time: float,
    ) -> None:
        """One scan that was compared with the map, of ``height`` m over the ground as it was before
        anything was lifted; times in s, variances in m^2, as of `departure.Departure`."""
        if self._last is not None:
            then, before, unsure = self._last
            after = abs(time - then)
            common = math.exp(-after / correlation_time) if correlation_time > 0.0 else 0.0
            step = 0.5 * (height - before) ** 2
            scans = 1.0 + max(time - since, 0.0) / max(after, 1e-3)
            self.rows.append((step, claimed, mapped, 0.5 * (noise + unsure), scans, common))
        self._last = (time, height, noise)

    def judge(self) -> PoseErrors | None:
        """What the steps say; None of fewer than `LEAST`.

        A scan's ground lies b_k = e_k - m + nu_k over the map: its pose error, the map's, and noise
        of variance R. From scan to scan the map hardly moves. Of errors of variance S and
        correlation rho, steps are of E[(b_k - b_k-1)^2] / 2 = (1 - rho) S + R: all of S if they are
        white, next to nothing if they persist. By the median, so that a wrong pose here and there
        says nothing, (1 - rho) S is D = median[(b_k - b_k-1)^2 / 2] / 0.455 - R, of relative
        deviation 3 / sqrt(K) of K steps. With four of these to spare, D > (1 - rho) S says that
        errors are whiter than claimed (rho > 0: if that is `WHITE_SHARE` of S or more) or
        larger (D > S); rho < `NEWS` and `CAUTIOUS`^2 D < (1 - rho) S that they persist or are
        smaller. A constant error is never seen: the map has it, too.
        """
        if len(self.rows) < LEAST:
            return None
        step, size, mapped, noise, _, common = np.median(np.array(self.rows), axis=0).tolist()
        seen = max(step / MEDIAN - noise, 0.0)
        claimed = (1.0 - common) * size
        spare = 1.0 + 12.0 / math.sqrt(len(self.rows))
        larger = step / MEDIAN > spare * (size + noise)
        white = common >= NEWS and seen > max(spare * (claimed + noise), WHITE_SHARE * size)
        smaller = CAUTIOUS**2 * (seen + noise) < claimed
        persist = common < NEWS and smaller
        other = size if persist else seen / self.rows[-1][4]
        return PoseErrors(
            seen=math.sqrt(seen),
            claimed=math.sqrt(claimed),
            size=math.sqrt(size),
            map_says=math.sqrt(mapped),
            white_says=math.sqrt(other),
            white=white,
            persist=persist,
            too_small=larger,
        )
