# SPDX-License-Identifier: Apache-2.0
"""What the command line shows: progress, results, messages."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from tqdm import tqdm

if TYPE_CHECKING:
    from quadtree_lss.replay.replay import ReplayResult


class ProgressBar:
    """A progress bar on stderr that is told what is done of how much; silent without terminal."""

    def __init__(self, what: str, unit: str, verbose: bool) -> None:
        self._bar = tqdm(
            desc=what,
            unit=unit,
            total=1,  # until `update` tells; None cannot be formatted
            file=sys.stderr,
            leave=False,
            disable=not wants_progress(verbose),
            bar_format="{desc} {percentage:3.0f}% |{bar}| {n:.0f}/{total:.0f} {unit} [{remaining}]",
        )

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def update(self, done: float, total: float) -> None:
        """Sets the bar."""
        self._bar.total = total
        self._bar.n = done
        self._bar.refresh()


def wants_progress(verbose: bool) -> bool:
    """Bars are for people: on a terminal, or when asked for."""
    return bool(verbose) or sys.stderr.isatty()


def print_result(result: ReplayResult) -> None:
    """Key figures of a replay and its ranked sites, on stdout."""
    summary, sites = result.summary, result.assessment.sites
    dropped = sum(summary["scans_dropped"].values())
    print(
        f"{summary['scans']} scans mapped, {dropped} dropped; {summary['leaves']} leaves;"
        f" {summary['duration']:.1f} s of bag at {summary['real_time_factor']:.1f} x real time\n"
        f"map update {summary['map_ms_median']:.2f} ms median, {summary['map_ms_p99']:.2f} ms 99 %;"
        f" landing site selection {summary['lss_ms']:.1f} ms;"
        f" peak memory {summary['peak_memory_mb']:.0f} MB"
    )
    if not len(sites.score):
        print(f"no safe site: {result.assessment.explanation}")
    else:
        print("rank        x        y        z    score  slope  roughness  to hazard  subscale")
    for k, (x, y, z) in enumerate(sites.position):
        print(
            f"{k + 1:4d} {x:8.2f} {y:8.2f} {z:8.2f} {sites.score[k]:8.4f}"
            f" {sites.slope_deg[k]:5.1f}° {sites.roughness[k]:7.3f} m³"
            f" {sites.hazard_distance[k]:8.2f} m {sites.subscale_height[k]:7.2f} m"
        )
    print(f"results in {result.out}")


def say(text: str) -> None:
    """One line on stderr."""
    print(f"quadtree-lss: {text}", file=sys.stderr)


def first_line(error: BaseException) -> str:
    """An error as one line."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'file'}: {error.strerror}"
    return (str(error) or type(error).__name__).splitlines()[0]
