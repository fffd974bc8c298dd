# SPDX-License-Identifier: Apache-2.0
"""Run a study with Dask: each flight is a task, and one file that is written atomically.

Name and content of the file have the number of the flight and a hash of what determines it.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import hashlib
import itertools
import json
import logging
import signal
import time
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import CancelledError
from dataclasses import asdict
from functools import cache
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, Literal

from quadtree_lss.desk.replay.files import locked, plain, write_bytes, write_json
from quadtree_lss.lab.campaign.kinds import FILES, CampaignError, Case, Figures, Record, kind_of
from quadtree_lss.lab.campaign.study import Study, this_build
from quadtree_lss.lab.campaign.summary import CampaignResult, page, write_flights
from quadtree_lss.onboard.errors import one_line

Progress = Callable[[int, int], None]
#: Dask by default makes workers return freed memory page by page, which takes a sixth of the time
#: of a flight, and profiles them a hundred times a second; this disables both.
DASK_SETTINGS = {
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 1 << 30,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 1 << 30,
    "distributed.worker.profile.enabled": False,
}
LOCAL_CLUSTER = {"threads_per_worker": 1, "dashboard_address": "127.0.0.1:0"}
LOCAL_CLUSTER |= {"processes": True, "silence_logs": logging.CRITICAL}
#: Period at which the workers are counted, s.
POLL_S = 0.5
#: Time without a worker after which a campaign fails, s.
MAX_S_WITHOUT_WORKER = 60.0


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
    """Fly the flights of a study that have no file in ``out`` and write the summary.

    Args:
        workers: Number of processes on this computer, by default one for each core.
        scheduler_address: Use the workers of this Dask scheduler instead.
        rerun: Flights to fly again.
        progress: Called with the numbers of done and of all flights.
        stop: Ends the campaign early by returning True.
        tell: Called with the address of the dashboard.

    Raises:
        CampaignError: Dask is missing, or the study cannot be flown.
        KeyboardInterrupt: stopped before a flight was done.
    """
    folder, stopped = Path(out), stop or (lambda: False)
    with locked(folder, CampaignError):
        again = set() if rerun == "failed" else {study.case(index).index for index in rerun}
        records: dict[int, Record] = {}
        for case in map(study.case, range(study.count)):
            record = None if case.index in again else read_record(folder, case)
            if record is not None and not (record.error and rerun == "failed"):
                records[case.index] = record
        missing = iter(i for i in range(study.count) if i not in records)
        report_progress = progress or (lambda done, total: None)
        report_progress(len(records), study.count)
        if len(records) < study.count:
            with _client(workers, scheduler_address) as client:
                if tell is not None:
                    tell(f"dashboard: {client.dashboard_link}")
                for record in _fly_all(client, study, folder, missing, stopped):
                    records[record.index] = record
                    report_progress(len(records), study.count)
        interrupted = len(records) < study.count
        if interrupted and not records:
            raise KeyboardInterrupt
        result = CampaignResult(folder, study, dict(sorted(records.items())), interrupted)
        write_json(folder / "campaign.json", result.as_dict())
        write_flights(folder / "flights.csv", result.records.values())
        write_bytes(folder / "campaign.html", page(result).encode())
        return result


def fly(case: Case) -> Figures | str:
    """Fly one flight on a worker; return its figures or the reason of its failure."""
    if (case.version, case.build) != this_build():
        return f"the worker has version and build {this_build()}, not {case.version, case.build}"
    try:
        figures = kind_of(case.kind).fly(case)
    except Exception as error:  # the other flights continue
        return one_line(f"{type(error).__name__}: {error}")
    gc.collect()  # large arrays are in reference cycles
    return figures


def _fly_all(
    client: Any, study: Study, out: Path, missing: Iterator[int], stop: Callable[[], bool]
) -> Iterator[Record]:
    """Submit one flight per worker at a time, which bounds memory; Dask also fails tasks that are
    queued at a worker that dies."""
    from dask.distributed import wait

    running: dict[Any, Case] = {}
    last_worker_time = time.monotonic()
    while not stop():
        try:
            threads = sum(client.nthreads().values())
            if threads:
                last_worker_time = time.monotonic()
            elif time.monotonic() - last_worker_time > MAX_S_WITHOUT_WORKER:
                raise CampaignError(
                    f"the scheduler has had no worker for {MAX_S_WITHOUT_WORKER:.0f} s"
                )
            for index in itertools.islice(missing, max(threads - len(running), not running)):
                case, key = study.case(index), f"flight-{index}-{id(running)}"
                running[client.submit(fly, case, key=key, pure=False)] = case
            if not running:
                break
            with contextlib.suppress(asyncio.TimeoutError):
                wait(list(running), timeout=POLL_S, return_when="FIRST_COMPLETED")
            ended = {f: _result_of(f) for f in running if f.done()}
        except (OSError, CancelledError) as error:
            raise CampaignError("the scheduler is lost; finished flights are kept") from error
        for future, found in ended.items():
            case = running.pop(future)
            figures, error = ({}, found) if isinstance(found, str) else (found, "")
            yield write_record(out, case, figures, error)
            future.release()
    for future in running:
        future.cancel()


def key_of(case: Case) -> str:
    """Hash of everything that determines a flight."""
    content = asdict(case)
    del content["labels"]
    for part in (content["conditions"], content["parameters"]):
        part |= {name: _hash_of(str(part[name])) for name in FILES if part.get(name)}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


@cache
def _hash_of(path: str) -> str:
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as error:
        raise CampaignError(f"{path}: {error.strerror}") from error


def record_path(out: Path, index: int, key: str) -> Path:
    return out / "flights" / f"{index:06d}-{key}.json"


def read_record(out: Path, case: Case) -> Record | None:
    """Read the file of a flight; None without one. Raises `CampaignError`: it is malformed or
    renamed."""
    path = record_path(out, case.index, key_of(case))
    if not path.exists():
        return None
    try:
        if not path.is_file():  # reading a named pipe would block
            raise ValueError
        record = Record(**json.loads(path.read_text(encoding="utf-8")))
        if record_path(out, record.index, record.key) != path:
            raise ValueError
        return record
    except (OSError, ValueError, TypeError, RecursionError):
        fix = "use --rerun or delete the file"
        raise CampaignError(f"{path} is not the record of this flight: {fix}") from None


def write_record(out: Path, case: Case, figures: Figures, error: str = "") -> Record:
    """Write the file of a flight; return its content."""
    identity = case.index, case.seed, case.scenario, dict(case.labels)
    record = Record(*identity, plain(figures), error, key_of(case), case.version, case.build)
    text = json.dumps(plain(asdict(record)), indent=1, allow_nan=False)
    write_bytes(record_path(out, record.index, record.key), (text + "\n").encode())
    return record


def _result_of(future: Any) -> Figures | str:
    if future.status != "error":
        return future.result()
    error = future.exception()
    if type(error).__name__ == "KilledWorker":  # its text contains addresses
        return "the worker died at each attempt"
    return one_line(f"{type(error).__name__}: {error}")


@contextlib.contextmanager
def _client(workers: int | None, scheduler_address: str | None) -> Iterator[Any]:
    try:
        import dask
        from dask.distributed import Client
    except ImportError as error:
        raise CampaignError("campaigns need Dask: pip install distributed bokeh") from error
    for name in ("distributed", "distributed.client", "asyncio", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with contextlib.ExitStack() as stack:
        try:
            if scheduler_address:
                client = stack.enter_context(Client(scheduler_address, timeout="20s"))
            else:
                with _sigint_blocked(), dask.config.set(DASK_SETTINGS):
                    client = stack.enter_context(Client(n_workers=workers, **LOCAL_CLUSTER))
        except (OSError, ValueError, RuntimeError, asyncio.TimeoutError) as error:
            which = "no scheduler" if scheduler_address else "the workers could not be started"
            msg = f"{which}: {one_line(str(error) or type(error).__name__)}"
            raise CampaignError(msg) from error
        yield client


@contextlib.contextmanager
def _sigint_blocked() -> Iterator[None]:
    """Block SIGINT; child processes inherit this, and this process receives it afterwards."""
    resource_tracker.ensure_running()  # its start would remove the block
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
