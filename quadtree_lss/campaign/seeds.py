# SPDX-License-Identifier: Apache-2.0
"""Simulate, replay and score many seeds: what holds for one flight may be luck."""

from __future__ import annotations

import csv
import json
import os
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Future,
    wait,
)
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import quadtree_lss
from quadtree_lss.campaign.seed_summary import SeedsResult, csv_rows
from quadtree_lss.campaign.workers import workers
from quadtree_lss.config.settings import Config
from quadtree_lss.errors import QuadtreeLssError
from quadtree_lss.evaluation.evaluate import EvaluationResult, evaluate
from quadtree_lss.evaluation.results import EvaluationError

Progress = Callable[[int, int], None]
"""Called with the steps that are done and the steps there are (three per seed)."""

_STEPS = 3
_LOOK_S = 0.5
_LOST = "its process was ended from outside (out of memory?)"
_LONGEST_RANGE = 10_000


@dataclass(frozen=True)
class FlightOptions:
    """What is flown for every seed; see `quadtree_lss.simulation.simulate`."""

    scenario: str = "morpheus"
    duration: float | None = None
    terrain: str | None = None
    range_noise: float | None = None
    outliers: float = 0.0
    dropouts: float = 0.0
    flights: int = 1


@dataclass(frozen=True)
class _Task:
    seed: int
    flight: FlightOptions
    config: Config
    place: Path
    results: Path
    figures: bool

    @property
    def note(self) -> Path:
        """Says with which options the flight beside it was made."""
        return self.place / "flight.json"

    def note_text(self) -> str:
        made = {"seed": self.seed, **asdict(self.flight), "version": quadtree_lss.__version__}
        return json.dumps(made, indent=2) + "\n"


def parse_seeds(text: str) -> list[int]:
    """Seeds from ``101-120``, ``1,2,7`` or both, each once; raises `EvaluationError`."""
    seeds: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?", part)
        if match is None:
            msg = f"seeds {text!r}: expected numbers and ranges, such as 101-120 or 1,2,7"
            raise EvaluationError(msg)
        first, last = int(match[1]), int(match[2] or match[1])
        if not first <= last < first + _LONGEST_RANGE:
            msg = f"seeds {text!r}: {first}-{last} is no range of at most {_LONGEST_RANGE} seeds"
            raise EvaluationError(msg)
        seeds += range(first, last + 1)
    twice = [seed for seed, count in Counter(seeds).items() if count > 1]
    if twice:
        named = ", ".join(map(str, twice[:5])) + (", …" if len(twice) > 5 else "")
        msg = f"seeds {text!r}: named more than once: {named}"
        raise EvaluationError(msg)
    return seeds


def evaluate_seeds(
    seeds: Sequence[int],
    out: str | Path,
    config: Config,
    flight: FlightOptions | None = None,
    *,
    bags: str | Path | None = None,
    jobs: int = 2,
    figures: bool = False,
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
) -> SeedsResult:
    """Fly, map and score every seed; writes ``evaluation.json``, ``.csv``, ``seeds.png``.

    Args:
        seeds: Of terrain and noise.
        out: Folder; results of each seed go into ``seed_<n>``.
        config: Of mapping and landing site selection.
        flight: What is flown.
        bags: Folder of the simulated flights (default ``out/flights``). A flight that was made
            there with the same options is used again.
        jobs: Processes, 1 or 2.
        figures: Also draw the figures of every seed.
        progress: See `Progress`.
        stop: Asked now and then; once it answers True, the result is of the seeds scored so far.

    Raises:
        EvaluationError: No seeds, a folder that cannot be written, or no seed could be scored.
            Single failures are in the result's ``failed``.
        KeyboardInterrupt: Stopped before a seed was scored.
    """
    if not seeds or jobs not in (1, 2):
        msg = "need at least one seed" if not seeds else f"jobs must be 1 or 2, not {jobs}"
        raise EvaluationError(msg)
    flight, folder = flight or FlightOptions(), Path(out)
    flights = folder / "flights" if bags is None else Path(bags)
    for place in (folder, flights):
        try:
            place.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            msg = f"cannot create {place}: {error.strerror}"
            raise EvaluationError(msg) from error
    tasks = [
        _Task(
            seed=seed,
            flight=flight,
            config=config,
            place=flights / f"{flight.scenario}_{seed}",
            results=folder / f"seed_{seed}",
            figures=figures,
        )
        for seed in dict.fromkeys(seeds)
    ]
    scored, failed, stopped = _run_all(
        tasks, jobs, progress or (lambda done, total: None), stop or (lambda: False)
    )
    if stopped and not scored:
        raise KeyboardInterrupt
    if not scored:
        seed, reason = next(iter(failed.items()))
        msg = f"no seed could be scored; seed {seed}: {reason}"
        raise EvaluationError(msg)
    result = SeedsResult(folder, asdict(flight), scored, failed, stopped)
    _write(result, config)
    return result


def _run_all(
    tasks: Sequence[_Task], jobs: int, progress: Progress, stop: Callable[[], bool]
) -> tuple[dict[int, EvaluationResult], dict[int, str], bool]:
    """Each task through its steps; tasks do not wait for each other.

    Returns:
        Scores and failures by seed, and whether it was stopped.
    """
    scored: dict[int, EvaluationResult] = {}
    failed: dict[int, str] = {}
    done, total = 0, _STEPS * len(tasks)
    progress(done, total)
    steps: tuple[Callable[[_Task], EvaluationResult | None], ...] = (_fly, _map, _score)
    with workers(min(jobs, len(tasks))) as (start, end_workers):
        waiting = list(reversed(tasks))
        running: dict[Future[EvaluationResult | None], tuple[_Task, int]] = {}
        try:
            while (waiting or running) and not stop():
                while waiting and len(running) < jobs:
                    task = waiting.pop()
                    running[start(steps[0], task)] = (task, 0)
                for future in wait(running, _LOOK_S, FIRST_COMPLETED).done:
                    task, step = running.pop(future)
                    try:
                        outcome = future.result()
                    except (QuadtreeLssError, OSError, MemoryError) as error:
                        failed[task.seed] = str(error) or type(error).__name__
                        done += _STEPS - step
                    else:
                        done += 1
                        if outcome is not None:
                            scored[task.seed] = outcome
                        else:
                            running[start(steps[step + 1], task)] = (task, step + 1)
                    progress(done, total)
        except (BrokenExecutor, SystemExit):  # a worker has gone
            if not stop():
                failed |= {t.seed: _LOST for t in tasks if t.seed not in scored | failed}
        if stop():
            end_workers()
    order = [task.seed for task in tasks]
    complete = len(scored) + len(failed) == len(tasks)
    return {seed: scored[seed] for seed in order if seed in scored}, failed, not complete


def _fly(task: _Task) -> None:
    """Simulate the flight unless it is there."""
    from quadtree_lss.simulation import simulate

    wanted = task.note_text()
    if task.note.is_file() and task.note.read_text(encoding="utf-8") == wanted:
        return
    task.note.unlink(missing_ok=True)
    options = {key: value for key, value in asdict(task.flight).items() if key != "scenario"}
    simulate(task.flight.scenario, task.place / "bag", seed=task.seed, overwrite=True, **options)
    task.note.write_text(wanted, encoding="utf-8")


def _map(task: _Task) -> None:
    from quadtree_lss.replay.replay import replay

    replay(task.place / "bag", task.results, task.config, report=False)


def _score(task: _Task) -> EvaluationResult:
    truth = task.place / "truth.npz"
    return evaluate(task.results, truth, consistency=False, figures=task.figures)


def _write(result: SeedsResult, config: Config) -> None:
    from quadtree_lss.campaign.figures_seeds import draw_seeds
    from quadtree_lss.config.loading import dump_config

    text = json.dumps(result.as_dict(), indent=2, allow_nan=False)
    _replace(result.out / "evaluation.json", text + "\n")
    _replace(result.out / "config.yaml", dump_config(config))
    path = result.out / "evaluation.csv"
    rows: list[Mapping[str, Any]] = csv_rows(result)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    draw_seeds(result.out / "seeds.png", result)


def _replace(path: Path, text: str) -> None:
    part = path.with_name(f".{path.name}.part")
    part.write_text(text, encoding="utf-8")
    os.replace(part, path)
