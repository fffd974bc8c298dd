# SPDX-License-Identifier: Apache-2.0
"""The folder of a campaign: a file for each flight, which is the checkpoint.

A flight's file holds what is the same whenever it is flown, and its own checksum. Its name has the
number of the flight and a key of all that decides it, as its content has; it appears in one step.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from quadtree_lss.desk.replay.files import plain, write_bytes, writing
from quadtree_lss.lab.campaign.kinds import CampaignError, Case, Value

MOST_FLIGHTS = 1_000_000
FILES = ("terrain", "lss.risk_model")
"""Conditions and parameters that name a file, whose content decides a flight."""


@dataclass(frozen=True)
class Record:
    """What is known of a flight: its figures, or why there are none."""

    index: int
    seed: int
    scenario: str
    labels: dict[str, Value]
    figures: dict[str, Value]
    error: str = ""
    key: str = ""
    version: str = ""
    build: str = ""


def key_of(case: Case) -> str:
    """Of everything that decides a flight: another key, another flight."""
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


def record_name(index: int, key: str) -> str:
    return f"{index:06d}-{key}.json"


class Store:
    """Results in ``out/flights``."""

    def __init__(self, out: str | Path) -> None:
        self.out = Path(out)
        self._flights = self.out / "flights"

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Within it, nobody else runs a campaign in this folder."""
        with writing(self.out, CampaignError):
            self._flights.mkdir(parents=True, exist_ok=True)
            lock = (self.out / ".lock").open("w")
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise CampaignError(f"{self.out}: another campaign runs there") from None
            yield

    def path(self, case: Case) -> Path:
        return self._flights / record_name(case.index, key_of(case))

    def read(self, case: Case) -> Record | None:
        """The record of a flight, None if it has not been flown; raises as of `read_record`."""
        path = self.path(case)
        return read_record(path) if path.exists() else None

    def write(self, case: Case, figures: dict[str, Value], error: str = "") -> Record:
        """Keep what a flight gave."""
        of = case.index, case.seed, case.scenario, dict(case.labels)
        record = Record(*of, plain(figures), error, key_of(case), case.version, case.build)
        content = plain(asdict(record))
        text = json.dumps({**content, "checksum": _checksum(content)}, indent=1, allow_nan=False)
        write_bytes(self.path(case), (text + "\n").encode())
        return record


def read_record(path: Path) -> Record:
    """A flight's file. Raises `CampaignError`: it is none, or was changed or copied."""
    try:
        content: Any = json.loads(path.read_text(encoding="utf-8"))
        told = content.pop("checksum")
        record = Record(**content)
        name = record_name(record.index, record.key)
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        why = "is no record of a flight"
    else:
        if told == _checksum(content) and name == path.name:
            return record
        why = f"is not as it was written, but of {name}" if name != path.name else "was changed"
    msg = f"{path} {why}; with --rerun, or without the file, it is flown again"
    raise CampaignError(msg)


def _checksum(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()
