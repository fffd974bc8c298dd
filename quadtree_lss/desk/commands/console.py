# SPDX-License-Identifier: Apache-2.0
"""Output of the command line: progress, results, messages."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from quadtree_lss.onboard.errors import one_line

if TYPE_CHECKING:
    from quadtree_lss.desk.replay.results import ReplayResult
    from quadtree_lss.desk.replay.stream import Progress
    from quadtree_lss.onboard.core.landing.result import Sites


SCANS = """\
{scans} scans mapped, {dropped} dropped; {leaves} leaves; {duration:.1f} s of bag at \
{real_time_factor:.1f} x real time
{used}
map update {map_ms_median:.2f} ms median, {map_ms_p99:.2f} ms 99 %; \
landing site selection {lss_ms:.1f} ms; peak memory {peak_memory_mb:.0f} MB"""
MAPS = """\
{maps} maps read, the last one assessed; {leaves} leaves; {duration:.1f} s of bag at \
{real_time_factor:.1f} x real time
landing site selection {lss_ms:.1f} ms"""
MODEL = """\
{posts[0]} x {posts[1]} posts, {post_spacing:g} m apart; heights {height_range[0]:.1f} to \
{height_range[1]:.1f} m, median slope {median_slope_deg:.1f}°
landing site selection {lss_ms:.0f} ms; {explanation}"""
"""Summaries of a replay of scans, of a replay of maps, and of an elevation model."""
BAR = "{desc} {percentage:3.0f} % |{bar}| {n:.0f} of {total:.0f} {unit}, {remaining} left"


class _Quiet:
    on = False  # with ``-q``


@contextlib.contextmanager
def quiet(on: bool, json: bool = False) -> Iterator[None]:
    """Context that hides all output except errors and, with ``json``, JSON."""
    before, _Quiet.on = _Quiet.on, on
    hide = on and not json
    stdout = contextlib.redirect_stdout(io.StringIO()) if hide else contextlib.nullcontext()
    try:
        with stdout:
            yield
    finally:
        _Quiet.on = before


@contextlib.contextmanager
def progress_bar(what: str, unit: str, verbose: bool, after: str = "") -> Iterator[Progress]:
    """Context that shows a progress bar on stderr, if that is a terminal or ``verbose``; yields the
    function that updates it. ``unit``: plural, or ``s`` for seconds of a bag. ``after``: activity
    to show when all units are done."""
    if _Quiet.on or not (verbose or sys.stderr.isatty()):
        yield lambda done, total: None
        return
    from tqdm import tqdm  # takes long to import

    options: dict[str, Any] = {"total": 1, "file": sys.stderr, "leave": False, "bar_format": BAR}
    with tqdm(desc=what, unit=unit, **options) as bar:

        def update(done: float, total: float) -> None:
            if after and done >= total:
                bar.bar_format, bar.desc = "{desc} …", after
            bar.total, bar.n = total, done
            bar.refresh()

        yield update


@contextlib.contextmanager
def interruption(then: str) -> Iterator[Callable[[], bool]]:
    """Context that yields whether Ctrl-C was pressed; a second one stops at once. ``then``: work
    that follows the first one, for the message."""
    asked, before = threading.Event(), signal.getsignal(signal.SIGINT)

    def on_interrupt(number: int, frame: object) -> None:
        asked.set()
        signal.signal(signal.SIGINT, before)
        # print is not reentrant.
        text = f"quadtree-lss: stopping: {one_line(then)} (Ctrl-C again stops at once)\n"
        end = "\n" if sys.stderr.isatty() else ""
        with contextlib.suppress(OSError):
            os.write(2, f"{end}{text}".encode(errors="replace"))

    signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield asked.is_set
    finally:
        signal.signal(signal.SIGINT, before)


def result_text(result: ReplayResult) -> str:
    """Format a replay: summary, ranked sites, and the file to open."""
    from quadtree_lss.desk.replay.results import aligned, points_line  # the core: slow to import

    summary, sites = result.summary, result.assessment.sites
    form = SCANS if result.timings else MODEL if "posts" in summary else MAPS
    dropped = sum(summary["scans_dropped"].values())
    used = points_line(summary["points"], summary["points_dropped"])
    text = form.format(**summary, dropped=dropped, used=used)
    lines = [text, *aligned(_site_rows(sites), ">")]
    if not len(sites):
        lines = [text.removesuffix(f"; {result.assessment.explanation}"), _without_site(result)]
    if result.out is not None:
        lines.append(f"results in {one_line(result.out)}")
        page = result.out / "report.html"
        if page.exists():
            lines.append(f"open {one_line(page)}")
    return "\n".join(lines)


def _without_site(result: ReplayResult) -> str:
    """Explain why there is no site, as the headline of the page does."""
    if result.out is None:
        return result.assessment.explanation
    from quadtree_lss.desk.exchange.saved import load_results
    from quadtree_lss.desk.report.headline import verdict

    found = verdict(load_results(result.out))
    return f"{found.answer.rstrip('.')}: {found.ground[:1].lower()}{found.ground[1:]}"


def _site_rows(sites: Sites) -> list[Sequence[str]]:
    from quadtree_lss.onboard.core.landing.result import shown

    columns = {
        "rank": map(str, range(1, len(sites) + 1)),
        **{axis: map("{:.2f}".format, sites.position[:, k]) for k, axis in enumerate("xyz")},
        "probability": map(shown, sites.probability),
        "score": map("{:.4f}".format, sites.score),
        "slope": map("{:.1f}°".format, sites.slope_deg),
        "roughness": map("{:.3f} m".format, sites.roughness),
        "to hazard": map("{:.2f} m".format, sites.hazard_distance),
        "subscale": map("{:.2f} m".format, sites.subscale_height),
    }
    return [tuple(columns), *zip(*columns.values(), strict=True)]


def say(text: str) -> None:
    print(f"quadtree-lss: {one_line(text)}", file=sys.stderr)


def warn(text: str) -> None:
    """Print one line on stderr, unless ``-q``."""
    if not _Quiet.on:
        say(text)


def first_line(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'file'}: {error.strerror}"
    return (str(error) or type(error).__name__).splitlines()[0]
