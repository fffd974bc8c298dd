# SPDX-License-Identifier: Apache-2.0
"""The folder of a campaign: one file for each flight, written atomically.

Name and content include the number of the flight and a hash of everything that determines it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

from quadtree_lss.desk.replay.files import locked, plain, write_bytes, writing
from quadtree_lss.lab.campaign.kinds import CampaignError, Case, Value

MAX_FLIGHTS = 1_000_000
#: Conditions and parameters that name a file; the hash covers its content.
FILES = ("terrain", "lss.risk_model")


@dataclass(frozen=True)
class Record:
    """Figures or error of a flight."""

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


def record_name(index: int, key: str) -> str:
    return f"{index:06d}-{key}.json"


class Store:
    """Results in ``out/flights``."""

    def __init__(self, out: str | Path) -> None:
        self.out = Path(out)
        self._flights = self.out / "flights"

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Lock the folder against other campaigns."""
        with locked(self.out, CampaignError):
            with writing(self.out, CampaignError):
                self._flights.mkdir(exist_ok=True)
            yield

    def path(self, case: Case) -> Path:
        return self._flights / record_name(case.index, key_of(case))

    def read(self, case: Case) -> Record | None:
        """Return the record of a flight, or None; raises like `read_record`."""
        path = self.path(case)
        return read_record(path) if path.exists() else None

    def write(self, case: Case, figures: dict[str, Value], error: str = "") -> Record:
        identity = case.index, case.seed, case.scenario, dict(case.labels)
        record = Record(*identity, plain(figures), error, key_of(case), case.version, case.build)
        text = json.dumps(plain(asdict(record)), indent=1, allow_nan=False)
        write_bytes(self.path(case), (text + "\n").encode())
        return record


def read_record(path: Path) -> Record:
    """Read the file of a flight. Raises `CampaignError`: it is malformed or renamed."""
    try:
        if not path.is_file():  # reading a named pipe would block
            raise ValueError
        record = Record(**json.loads(path.read_text(encoding="utf-8")))
        if record_name(record.index, record.key) != path.name:
            raise ValueError
        return record
    except (OSError, ValueError, TypeError, RecursionError):
        fix = "use --rerun or delete the file"
        raise CampaignError(f"{path} is not the record of this flight: {fix}") from None
