# SPDX-License-Identifier: Apache-2.0
"""Studies: definitions of many flights in a YAML file (see ``studies/RESULTS.md``)."""

from __future__ import annotations

import itertools
import json
import math
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from quadtree_lss import build
from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.desk.replay.results import versions
from quadtree_lss.lab.campaign.kinds import FILES, CampaignError, Case, Kind, kind_of
from quadtree_lss.lab.evaluation.risk_families import log_uniform
from quadtree_lss.onboard.config.settings import values_from_config
from quadtree_lss.onboard.config.yaml_text import YamlError, read_yaml

KEYS = tuple("name kind scenario config seed flights seeds conditions parameters cases".split())
MAX_FLIGHTS = 1_000_000
CASE_KEYS = ("name", "scenario", "config", "conditions", "parameters")

DISTRIBUTIONS: dict[str, Callable[..., float]] = {
    "uniform": lambda generator, low, high: float(generator.uniform(low, high)),
    "log_uniform": log_uniform,
}


@dataclass(frozen=True)
class Drawn:
    """A value that is drawn for each flight."""

    distribution: str
    low: float
    high: float


Combination = Mapping[tuple[str, str], Any]
"""Values by (``scenario`` | ``conditions`` | ``parameters`` | ``case``, name)."""


@dataclass(frozen=True)
class Study:
    """The flights of a study: ``repeats`` flights of each combination; ``files`` has the
    configurations by case. The seeds are ``seeds``, or generated from ``seed``."""

    name: str
    kind_name: str
    seed: int
    repeats: int
    seeds: tuple[int, ...] = ()
    combinations: tuple[Combination, ...] = ({},)
    files: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    varied: tuple[str, ...] = ()

    @property
    def count(self) -> int:
        return self.repeats * len(self.combinations)

    @cached_property
    def drawn(self) -> frozenset[str]:
        values = (item for c in self.combinations for item in c.items())
        return frozenset(name for (_, name), value in values if isinstance(value, Drawn))

    @cached_property
    def kind(self) -> Kind:
        return kind_of(self.kind_name)

    def case(self, index: int) -> Case:
        """Return flight ``index``. Combinations alternate, so that more flights do not change the
        first ones; all combinations share their seeds, which permits comparisons in pairs."""
        if not 0 <= index < self.count:
            raise CampaignError(f"no flight {index}; the study has 0 to {self.count - 1}")
        turn, which = divmod(index, len(self.combinations))
        combination = self.combinations[which]
        if self.seeds:
            seed, entropy = self.seeds[turn], self.seeds[turn]
        else:
            sequence = np.random.SeedSequence(self.seed, spawn_key=(turn,))
            seed, entropy = int(sequence.generate_state(1, np.uint64)[0]) >> 11, self.seed
        values = {}
        for key, value in combination.items():
            if isinstance(value, Drawn):
                own = zlib.crc32(".".join(key).encode())
                sequence = np.random.SeedSequence(entropy, spawn_key=(turn, own))
                generator = np.random.default_rng(sequence)
                value = DISTRIBUTIONS[value.distribution](generator, value.low, value.high)
            values[key] = value
        files = self.files[str(values[("case", "case")])]
        overrides = {name: v for (part, name), v in values.items() if part == "parameters"}
        return Case(
            index,
            self.kind_name,
            str(values[("scenario", "scenario")]),
            seed,
            {name: v for (part, name), v in values.items() if part == "conditions"},
            _parameters(files, json.dumps(overrides, sort_keys=True)),
            {name: v for (_, name), v in values.items() if name in self.varied},
            *this_build(),
        )


@lru_cache(64)
def _parameters(files: tuple[str, ...], overrides: str) -> dict[str, Any]:
    config = load_config(files, json.loads(overrides), origin="the study")
    return dict(values_from_config(config))


@cache
def this_build() -> tuple[str, str]:
    """Version of the package and a digest of its sources, its risk model and its build."""
    found, kinds = versions(), (".py", ".yaml")
    files = [path for path in build.PACKAGE.rglob("*") if path.suffix in kinds]
    sources = {p.relative_to(build.PACKAGE).as_posix(): p.read_text("utf-8") for p in files}
    return found["quadtree_lss"], f"{build.digest(sources)[:8]}, {found['build']}"


def read_study(path: str | Path) -> Study:
    """Read and check a study. Raises `CampaignError`, or the errors of its parameters and files."""
    file = Path(path)
    try:
        content = read_yaml(file)
        if not isinstance(content, Mapping):
            raise CampaignError(f"a study is a mapping with some of {', '.join(KEYS)}")
        study = _study(content, file)
        for index in range(min(study.count, len(study.combinations))):
            study.case(index)
    except (CampaignError, YamlError) as error:
        raise CampaignError(f"{file}: {error}") from None
    return study


def _study(content: Mapping[Any, Any], file: Path) -> Study:
    _check_keys(content, KEYS, "the study")
    name_and_kind = str(content.get("name", file.stem)), str(content.get("kind", "map"))
    kind = kind_of(name_and_kind[1])
    seeds: tuple[int, ...] = ()
    if ("seeds" in content) == ("flights" in content):
        raise CampaignError("needs either seeds (101-120) or flights (a number, with seed)")
    if "seeds" in content:
        seeds = tuple(parse_seeds(str(content["seeds"])))
    seed = _whole(content.get("seed", 0), "seed", 0)
    repeats = len(seeds) or _whole(content["flights"], "flights", 1)
    combinations: list[Combination] = []
    files: dict[str, tuple[str, ...]] = {}
    cases = content.get("cases") or [{}]
    if not isinstance(cases, list) or not all(isinstance(case, Mapping) for case in cases):
        raise CampaignError("cases must be a list of mappings")
    for number, case in enumerate(cases, start=1):
        _check_keys(case, CASE_KEYS, f"case {number}")
        name = str(case.get("name", number))
        if name in files:
            raise CampaignError(f"two cases are called {name!r}")
        named = case.get("config", content.get("config", []))
        listed = named or [] if isinstance(named or [], list) else [named]
        files[name] = tuple(str(_resolve(entry, file)) for entry in listed)
        axes = _axes(content, {**case, "name": name}, kind, file)
        count = repeats * math.prod(map(len, axes.values()))
        if count > MAX_FLIGHTS:
            raise CampaignError(f"{count} flights; at most {MAX_FLIGHTS} are allowed")
        product = itertools.product(*axes.values())
        combinations += [dict(zip(axes, values, strict=True)) for values in product]
    keys = {key for c in combinations for key in c}
    values = {key: [c.get(key) for c in combinations] for key in keys}
    varied = {
        name
        for (_, name), of in values.items()
        if len({*map(repr, of)}) > 1 or any(isinstance(value, Drawn) for value in of)
    }
    flights = seed, repeats, seeds, tuple(combinations)
    return Study(*name_and_kind, *flights, files, tuple(sorted(varied)))


def _axes(
    content: Mapping[Any, Any], case: Mapping[Any, Any], kind: Kind, file: Path
) -> dict[tuple[str, str], list[Any]]:
    """Values of each entry of a case, which takes precedence over the rest of the study."""
    scenario = case.get("scenario", content.get("scenario", "morpheus"))
    parts: dict[Any, Any] = {("case", "case"): case["name"], ("scenario", "scenario"): scenario}
    for part in ("conditions", "parameters"):
        for given in (content.get(part) or {}, case.get(part) or {}):
            if not isinstance(given, Mapping):
                raise CampaignError(f"{part} must be a mapping")
            for key, value in given.items():
                parts[(part, str(key))] = value
    axes = {key: values_of(value, key[1]) for key, value in parts.items()}
    for (part, key), values in axes.items():
        named = {"conditions": [key], "scenario": values}.get(part, [])
        known = kind.scenarios if part == "scenario" else kind.conditions
        if wrong := [name for name in named if name not in known]:
            what = part.removesuffix("s")
            raise CampaignError(f"unknown {what} {wrong[0]!r}; there are {', '.join(known)}")
        if key in FILES:
            axes[(part, key)] = [_resolve(value, file) for value in values]
    return axes


def _resolve(name: Any, file: Path) -> Any:
    """Return the path of a file beside the study, or the name itself."""
    there = file.parent / str(name)
    return str(there.resolve()) if there.is_file() else name


def _check_keys(given: Mapping[Any, Any], known: Sequence[str], where: str) -> None:
    unknown = [str(key) for key in given if key not in known]
    if unknown:
        raise CampaignError(f"unknown key {unknown[0]!r} in {where}; there are {', '.join(known)}")


def _whole(value: object, name: str, least: int) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise CampaignError(f"{name} must be a whole number from {least}, not {value!r}")
    return value


def values_of(value: Any, name: str) -> list[Any]:
    """Return the values of an entry of a study: one, several, or one that is drawn."""
    if isinstance(value, list):
        if not value:
            raise CampaignError(f"{name}: an empty list")
        if drawn := [one for one in value if isinstance(one, (list, Mapping))]:
            raise CampaignError(f"{name}: {drawn[0]} in a list; it holds only values")
        return value
    if not isinstance(value, Mapping):
        return [value]
    try:
        ((distribution, of),) = value.items()
        low, high = (float(v) for v in of)
        if (
            distribution in DISTRIBUTIONS
            and -math.inf < low < high < math.inf
            and (low > 0 or distribution == "uniform")
        ):
            return [Drawn(distribution, low, high)]
    except (TypeError, ValueError):
        pass
    forms = "uniform: [low, high] or log_uniform: [low, high]"
    raise CampaignError(f"{name}: {value} is not a value, a list, {forms}")


def parse_seeds(text: str) -> list[int]:
    """Parse distinct numbers such as ``101-120,7``. Raises `CampaignError`: the text is invalid."""
    seeds: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if not first <= last < first + MAX_FLIGHTS:
            raise CampaignError(f"{text!r}: expected numbers and ranges, such as 101-120 or 1,2,7")
        seeds += range(first, last + 1)
    if len(set(seeds)) < len(seeds):
        raise CampaignError(f"{text!r}: a number is named more than once")
    return seeds
