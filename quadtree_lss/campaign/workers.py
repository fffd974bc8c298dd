# SPDX-License-Identifier: Apache-2.0
"""Processes that can be stopped without half-written files and without tracebacks."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import active_children, get_context
from typing import Any

Start = Callable[[Callable[[Any], Any], Any], Future[Any]]


def _here(step: Callable[[Any], Any], task: Any) -> Future[Any]:
    """Runs it at once, in this process; the finished future."""
    future: Future[Any] = Future()
    try:
        future.set_result(step(task))
    except Exception as error:
        future.set_exception(error)
    return future


@contextmanager
def workers(jobs: int) -> Iterator[tuple[Start, Callable[[], None]]]:
    """Processes that work while the context lasts; with one job, this process does the work.

    Returns:
        What starts ``step(task)`` in one of them, and what ends all of them in the middle of their
        work. The future of a step whose process has gone raises BrokenExecutor or SystemExit.
    """
    if jobs == 1:
        yield _here, lambda: None
        return
    # Spawned, not forked: the parent may run threads of its own (progress bar, linear algebra).
    before = set(active_children())
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), initializer=_stop_quietly)

    def start(step: Callable[[Any], Any], task: Any) -> Future[Any]:
        with _deaf_children():
            return pool.submit(step, task)

    def end() -> None:
        for worker in set(active_children()) - before:
            worker.terminate()

    try:
        yield start, end
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _deaf_children() -> Iterator[None]:
    """Processes that are started within it ignore Ctrl-C: what it means is the parent's affair."""
    try:
        heard = signal.signal(signal.SIGINT, signal.SIG_IGN)
    except ValueError:  # not the main thread, which alone hears it
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, heard)


def _stop_quietly() -> None:
    """A worker that is ended leaves no half bag behind."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(130))
