# SPDX-License-Identifier: Apache-2.0
"""Content of ``history.npz``: scans and assessments over time, for the page's slider."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.core.landing.hazards import UNSEEN
from quadtree_lss.onboard.core.landing.result import LandingAssessment
from quadtree_lss.onboard.messages.intake import ReadyScan

MAX_ASSESSMENTS, MAX_SCANS = 240, 4000
"""Limits of the numbers of assessments and scans that are kept."""
DECADES, STEPS = 4.0, 60.0
"""The risk r is stored as -STEPS * log10(r), limited to 10^-DECADES <= r: with 4 % resolution."""
_POINT_STEP = 16  # every n-th point of a scan is used for its outline
_ANGLES = np.arange(12) * (2.0 * np.pi / 12)
_DIRECTIONS = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])


class Thinned:
    """List of at most ``limit`` items, evenly spaced, and the last one."""

    def __init__(self, limit: int) -> None:
        self._limit, self._step, self._count = limit, 1, 0
        self._kept: list[Any] = []
        self._last: list[Any] = []

    def add(self, item: Any) -> None:
        if self._count % self._step == 0 and len(self._kept) == self._limit:
            self._kept, self._step = self._kept[::2], 2 * self._step
        keep = self._count % self._step == 0
        self._kept += [item] * keep
        self._last = [] if keep else [item]
        self._count += 1

    def all(self) -> list[Any]:
        return [*self._kept, *self._last]


class History:
    """Records assessments, lidar positions and outlines of scans."""

    def __init__(self) -> None:
        self._answers, self._scans = Thinned(MAX_ASSESSMENTS), Thinned(MAX_SCANS)

    def landing(self, now_ns: int, found: LandingAssessment) -> None:
        sites = found.sites
        ranked = sites.id, sites.position, sites.score, sites.probability
        seen = found.hazard & UNSEEN == 0
        risk = np.where(seen, found.risk, np.nan)
        stored = np.rint(-STEPS * np.log10(np.maximum(risk, 10.0**-DECADES)))
        self._answers.add(
            {
                "stamp_ns": found.stamp_ns,
                "corner": (found.x[0], found.y[0]),
                "seen": np.packbits(seen),
                "allowed": np.packbits(found.safe),
                "risk": np.nan_to_num(stored, nan=255.0).astype(np.uint8).ravel(),
                "sites": np.column_stack(ranked),
                "target": np.array([found.selected.id, *found.selected.position]),
                "target_why": found.why,
            }
        )

    def scan(self, scan: ReadyScan) -> None:
        points = scan.points_lidar.reshape(-1, 3)[::_POINT_STEP]
        ground = points @ scan.pose.rotation_map_lidar[:2].T + scan.pose.position[:2]
        ground = ground[np.isfinite(ground[:, 0]) & np.isfinite(ground[:, 1])]
        if not len(ground):
            ground = np.full((1, 2), np.nan)
        outline = ground[(ground @ _DIRECTIONS.T).argmax(axis=0)]
        self._scans.add((scan.stamp_ns, scan.pose.position.copy(), outline))

    def arrays(self, *, risk: bool = True) -> dict[str, NDArray[Any]]:
        """Return the content of the file, map frame, m. ``risk``: include the risk of each grid
        point, which is most of the file."""
        scans, answers = self._scans.all(), self._answers.all()
        sites = np.concatenate([a["sites"] for a in answers]) if answers else np.zeros((0, 6))
        outlines = np.array([outline for _, _, outline in scans])

        def column(name: str, kind: type | None = None) -> NDArray[Any]:
            return np.array([answer[name] for answer in answers], kind)

        return {
            "scan_stamp_ns": np.array([stamp for stamp, _, _ in scans], dtype=np.int64),
            "scan_position": np.array([position for _, position, _ in scans]).reshape(-1, 3),
            "scan_outline": outlines.reshape(-1, len(_DIRECTIONS), 2),
            "answer_stamp_ns": column("stamp_ns", np.int64),
            "answer_corner": column("corner").reshape(-1, 2),
            "seen": column("seen", np.uint8),
            "allowed": column("allowed", np.uint8),
            **({"risk": column("risk")} if risk else {}),
            "target": column("target").reshape(-1, 4),
            "target_why": column("target_why", str),
            "site_answer": np.repeat(np.arange(len(answers)), [len(a["sites"]) for a in answers]),
            "site_id": sites[:, 0].astype(np.int64),
            "site_position": sites[:, 1:4],
            "site_score": sites[:, 4],
            "site_probability": sites[:, 5],
        }
