# SPDX-License-Identifier: Apache-2.0
"""What the command line shows: progress, results, messages."""

from __future__ import annotations

import contextlib
import io
import signal
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from quadtree_lss.errors import one_line

if TYPE_CHECKING:
    from quadtree_lss.replay.result import ReplayResult

_BAR = "{desc} {percentage:3.0f}% |{bar}| {n:.0f}/{total:.0f} {unit}, {rate_fmt}, {remaining} left"


class _Quiet:
    """Whether ``-q`` was given, for this run of `cli.main`."""

    on = False


@contextlib.contextmanager
def quiet(on: bool) -> Iterator[None]:
    """Within it, nothing but errors (and JSON, which is asked for) is shown."""
    before, _Quiet.on = _Quiet.on, on
    hidden = contextlib.redirect_stdout(io.StringIO()) if on else contextlib.nullcontext()
    try:
        with hidden:
            yield
    finally:
        _Quiet.on = before


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
            bar_format=_BAR,
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


class Interruption:
    """Context manager that turns the first Ctrl-C into a wish to stop; the second one stops."""

    def __init__(self) -> None:
        self._asked = False
        self._before: Any = None

    def __enter__(self) -> Interruption:
        with contextlib.suppress(ValueError):  # not in the main thread: nothing to handle
            self._before = signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def asked(self) -> bool:
        """Whether there was a Ctrl-C."""
        return self._asked

    def _note(self, number: int, frame: object) -> None:
        self._asked = True
        signal.signal(signal.SIGINT, self._before)


def wants_progress(verbose: bool) -> bool:
    """Bars are for people: on a terminal, or when asked for."""
    return not _Quiet.on and (bool(verbose) or sys.stderr.isatty())


def print_result(result: ReplayResult) -> None:
    """Key figures of a replay and its ranked sites, on stdout."""
    from quadtree_lss.replay.points import points_line  # the core: slow to import

    summary, sites = result.summary, result.assessment.sites
    dropped = sum(summary["scans_dropped"].values())
    speed = f"{summary['duration']:.1f} s of bag at {summary['real_time_factor']:.1f} x real time"
    if result.timings:
        print(
            f"{summary['scans']} scans mapped, {dropped} dropped; {summary['leaves']} leaves;"
            f" {speed}\n"
            f"{points_line(summary['points'], summary['points_dropped'])}\n"
            f"map update {summary['map_ms_median']:.2f} ms median,"
            f" {summary['map_ms_p99']:.2f} ms 99 %;"
            f" landing site selection {summary['lss_ms']:.1f} ms;"
            f" peak memory {summary['peak_memory_mb']:.0f} MB"
        )
    else:
        print(
            f"{summary['maps']} maps read, the last one assessed; {summary['leaves']} leaves;"
            f" {speed}\nlanding site selection {summary['lss_ms']:.1f} ms"
        )
    if not len(sites.score):
        print(f"no safe site: {result.assessment.explanation.removeprefix('no safe site: ')}")
    else:
        print("rank        x        y        z    score  slope  roughness  to hazard  subscale")
    for k, (x, y, z) in enumerate(sites.position):
        print(
            f"{k + 1:4d} {x:8.2f} {y:8.2f} {z:8.2f} {sites.score[k]:8.4f}"
            f" {sites.slope_deg[k]:5.1f}° {sites.roughness[k]:7.3f} m"
            f" {sites.hazard_distance[k]:8.2f} m {sites.subscale_height[k]:7.2f} m"
        )
    if result.out is not None:
        print(f"results in {one_line(result.out)}")


def say(text: str) -> None:
    """One line on stderr."""
    print(f"quadtree-lss: {one_line(text)}", file=sys.stderr)


def warn(text: str) -> None:
    """One line on stderr, unless ``-q``."""
    if not _Quiet.on:
        say(text)


def first_line(error: BaseException) -> str:
    """An error as one line."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'file'}: {error.strerror}"
    return (str(error) or type(error).__name__).splitlines()[0]
