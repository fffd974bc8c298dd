# SPDX-License-Identifier: Apache-2.0
"""Fly a study with Dask: each flight is a task with a file as its result."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import itertools
import logging
import signal
import time
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import CancelledError
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, Literal

from quadtree_lss.desk.replay.files import write_bytes, write_json
from quadtree_lss.lab.campaign.campaign_page import page
from quadtree_lss.lab.campaign.kinds import CampaignError, Case, Figures, kind_of
from quadtree_lss.lab.campaign.store import Record, Store
from quadtree_lss.lab.campaign.study import Study, this_build
from quadtree_lss.lab.campaign.summary import CampaignResult, write_flights
from quadtree_lss.onboard.errors import one_line

Progress = Callable[[int, int], None]
#: Dask's workers return freed memory page by page (a sixth of a flight's time), and profile
#: themselves a hundred times a second; both off.
SETTINGS = {
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 1 << 30,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 1 << 30,
    "distributed.worker.profile.enabled": False,
}
LOCAL = {"threads_per_worker": 1, "dashboard_address": "127.0.0.1:0"}
LOCAL |= {"processes": True, "silence_logs": logging.CRITICAL}
#: Longest wait before the workers are counted again, s.
POLL_S = 0.5
#: One class from Python 3.11 on.
TIMED_OUT = (TimeoutError, asyncio.TimeoutError)
#: Longest time without a worker, s.
NO_WORKER_S = 60.0


def campaign(
    study: Study,
    out: str | Path,
    *,
    workers: int | None = None,
    scheduler_address: str | None = None,
    rerun: Collection[int] | Literal["failed"] = (),
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
    tell: Callable[[str], None] | None = None,
) -> CampaignResult:
    """Fly the flights of a study that have no file in ``out``, and those of ``rerun``; write the
    summary.

    They are flown by a number of ``workers`` on this computer, by default one for each core, or by
    the workers of the Dask scheduler at ``scheduler_address``. ``stop`` ends the campaign early by
    returning True; ``tell`` gets the address of the dashboard. Raises `CampaignError`: Dask is
    missing, or the study cannot be flown there; KeyboardInterrupt: stopped before a flight was
    done.
    """
    store, stopped = Store(out), stop or (lambda: False)
    with store.opened():
        again = set() if rerun == "failed" else {study.case(index).index for index in rerun}
        records: dict[int, Record] = {}
        for case in map(study.case, range(study.count)):
            record = None if case.index in again else store.read(case)
            if record is not None and not (record.error and rerun == "failed"):
                records[case.index] = record
        missing = iter(i for i in range(study.count) if i not in records)
        tell_progress = progress or (lambda done, total: None)
        tell_progress(len(records), study.count)
        if len(records) < study.count:
            with _client(workers, scheduler_address) as client:
                if tell is not None:
                    tell(f"dashboard: {client.dashboard_link}")
                for record in _fly_all(client, study, store, missing, stopped):
                    records[record.index] = record
                    tell_progress(len(records), study.count)
        interrupted = len(records) < study.count
        if interrupted and not records:
            raise KeyboardInterrupt
        result = CampaignResult(store.out, study, dict(sorted(records.items())), interrupted)
        write_json(store.out / "campaign.json", result.as_dict())
        write_flights(store.out / "flights.csv", result.records.values())
        write_bytes(store.out / "campaign.html", page(result).encode())
        return result


def keep(study: Study, out: str | Path, index: int) -> Path:
    """Fly ``index`` again and return the folder with all its results. Raises `CampaignError`: there
    is no such flight."""
    folder = Path(out) / "kept" / f"{index:06d}"
    study.kind.keep(study.case(index), folder)
    return folder


def fly(case: Case) -> Figures | str:
    """Figures of one flight on a worker, or the reason of its failure."""
    if (case.version, case.build) != this_build():
        return f"the worker has version and build {this_build()}, not {case.version, case.build}"
    try:
        figures = kind_of(case.kind).fly(case)
    except Exception as error:  # the other flights continue
        return one_line(f"{type(error).__name__}: {error}")
    gc.collect()  # large arrays are in reference cycles
    return figures


def _fly_all(
    client: Any, study: Study, store: Store, missing: Iterator[int], stop: Callable[[], bool]
) -> Iterator[Record]:
    """Submit one flight per worker at a time: this bounds memory, and Dask gives up tasks that wait
    at a dying worker."""
    from dask.distributed import wait

    running: dict[Any, Case] = {}
    seen = time.monotonic()
    while not stop():
        with _scheduler_errors():
            threads = sum(client.nthreads().values())
            if threads:
                seen = time.monotonic()
            elif time.monotonic() - seen > NO_WORKER_S:
                raise CampaignError(f"the scheduler has had no worker for {NO_WORKER_S:.0f} s")
            for index in itertools.islice(missing, max(threads - len(running), not running)):
                case, key = study.case(index), f"flight-{index}-{id(store)}"
                running[client.submit(fly, case, key=key, pure=False)] = case
            if not running:
                break
            with contextlib.suppress(*TIMED_OUT):
                wait(list(running), timeout=POLL_S, return_when="FIRST_COMPLETED")
            ended = {f: _outcome(f) for f in running if f.done()}
        for future, found in ended.items():
            case = running.pop(future)
            yield store.write(case, *(({}, found) if isinstance(found, str) else (found,)))
            future.release()
    for future in running:
        future.cancel()


@contextlib.contextmanager
def _scheduler_errors() -> Iterator[None]:
    """Raise `CampaignError` where the scheduler is lost."""
    try:
        yield
    except (OSError, CancelledError) as error:
        raise CampaignError("the scheduler is lost; what was flown is kept") from error


def _outcome(future: Any) -> Figures | str:
    if future.status != "error":
        return future.result()
    error = future.exception()
    if type(error).__name__ == "KilledWorker":  # its text contains addresses
        return "the worker that flew it died, each time it was tried"
    return one_line(f"{type(error).__name__}: {error}")


@contextlib.contextmanager
def _client(workers: int | None, scheduler_address: str | None) -> Iterator[Any]:
    try:
        import dask
        from dask.distributed import Client
    except ImportError as error:
        raise CampaignError("campaigns need Dask: pip install distributed bokeh") from error
    if workers and scheduler_address:
        raise CampaignError("workers and scheduler_address exclude one another")
    for name in ("distributed", "distributed.client", "asyncio", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with contextlib.ExitStack() as stack:
        try:
            if scheduler_address:
                client = stack.enter_context(Client(scheduler_address, timeout="20s"))
            else:
                with _sigint_blocked(), dask.config.set(SETTINGS):
                    client = stack.enter_context(Client(n_workers=workers, **LOCAL))
        except (OSError, ValueError, RuntimeError, *TIMED_OUT) as error:
            which = "no scheduler" if scheduler_address else "the workers could not be started"
            msg = f"{which}: {one_line(str(error) or type(error).__name__)}"
            raise CampaignError(msg) from error
        yield client


@contextlib.contextmanager
def _sigint_blocked() -> Iterator[None]:
    """Block SIGINT for child processes, which inherit that; this process gets it afterwards."""
    resource_tracker.ensure_running()  # its start would lift the block
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
