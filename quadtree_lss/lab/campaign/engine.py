# SPDX-License-Identifier: Apache-2.0
"""Fly a study on the cores of this computer: a process and a file for each flight."""

from __future__ import annotations

import contextlib
import itertools
import json
import multiprocessing
import os
import signal
from collections.abc import Callable, Collection, Iterator
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from quadtree_lss.lab.campaign.kinds import CampaignError, Case, Figures, kind_of
from quadtree_lss.lab.campaign.store import Record, Store
from quadtree_lss.lab.campaign.study import Study
from quadtree_lss.lab.campaign.summary import CampaignResult, write_summary
from quadtree_lss.onboard.errors import one_line

Progress = Callable[[int, int], None]
LOOK_S = 0.5
"""Longest time until ``stop`` is asked again, s."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Numerical libraries use one thread in each process: results do not depend on the computer."""


def campaign(
    study: Study,
    out: str | Path,
    workers: int | None = None,
    *,
    rerun: Collection[int] = (),
    rerun_failed: bool = False,
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
) -> CampaignResult:
    """Fly the flights of a study that have no file in ``out``, and those of ``rerun``, and write
    the summary. ``workers``: flights at a time, by default one for each core; ``stop`` ends it
    early by returning True. Raises `CampaignError`: the study cannot be flown; KeyboardInterrupt:
    stopped before a flight was done."""
    store, stopped = Store(out), stop or (lambda: False)
    with store.opened():
        again = {study.case(index).index for index in rerun}
        records: dict[int, Record] = {}
        for case in map(study.case, range(study.count)):
            record = None if case.index in again else store.read(case)
            if record is not None and not (record.error and rerun_failed):
                records[case.index] = record
        missing = (study.case(i) for i in range(study.count) if i not in records)
        tell_progress = progress or (lambda done, total: None)
        tell_progress(len(records), study.count)
        for case, found in _fly_all(missing, workers or os.cpu_count() or 1, stopped):
            figures, error = ({}, found) if isinstance(found, str) else (found, "")
            records[case.index] = store.write(case, figures, error)
            tell_progress(len(records), study.count)
        interrupted = len(records) < study.count
        if interrupted and not records:
            raise KeyboardInterrupt
        result = CampaignResult(store.out, study, dict(sorted(records.items())), interrupted)
        write_summary(result)
        return result


def flagged(out: str | Path) -> list[int]:
    """The worst flights on the campaign's page. Raises `CampaignError`: there is none."""
    try:
        worst = json.loads((Path(out) / "campaign.json").read_text("utf-8"))["worst"]
        return sorted({int(index) for pairs in worst.values() for index, _ in pairs})
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise CampaignError(f"{out} is no folder of a campaign that was summed up") from None


def keep(study: Study, out: str | Path, index: int) -> Path:
    """Fly ``index`` again and return the folder with all its results. Raises `CampaignError`: there
    is no such flight."""
    from quadtree_lss.lab.campaign.campaign_page import note_kept  # matplotlib

    case, folder = study.case(index), Path(out) / "kept" / f"{index:06d}"
    study.what.keep(case, folder)
    note_kept(Path(out), study.what.page)
    return folder


def _fly_all(
    missing: Iterator[Case], workers: int, stop: Callable[[], bool]
) -> Iterator[tuple[Case, Figures | str]]:
    """Fly the cases, ``workers`` at a time; give each with its figures or the reason of its
    failure, in the order in which they end."""
    for name in THREADS:
        os.environ.setdefault(name, "1")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__, "quadtree_lss.lab.campaign.mapped"])
    running: dict[Connection, tuple[Any, Case]] = {}
    try:
        while not stop():
            for case in itertools.islice(missing, workers - len(running)):
                ours, theirs = context.Pipe(duplex=False)
                process = context.Process(target=_fly, args=(case, theirs), daemon=True)
                process.start()
                theirs.close()
                running[ours] = process, case
            if not running:
                break
            for ended in wait(list(running), LOOK_S):
                assert isinstance(ended, Connection)
                process, case = running.pop(ended)
                found: Figures | str = "the process that flew it died"
                with contextlib.suppress(EOFError):
                    found = ended.recv()
                process.join()
                yield case, found
    finally:
        for process, _ in running.values():
            process.terminate()
            process.join()


def fly(case: Case) -> Figures | str:
    """Figures of one flight, or the reason of its failure."""
    try:
        return kind_of(case.kind).fly(case)
    except Exception as error:  # the other flights continue
        return one_line(f"{type(error).__name__}: {error}")


def _fly(case: Case, result: Connection) -> None:
    """Fly a case in a process of its own and send what `fly` returns."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent
    found = fly(case)
    with contextlib.suppress(BrokenPipeError):  # the parent was killed
        result.send(found)
