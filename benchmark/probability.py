# SPDX-License-Identifier: Apache-2.0
"""How far the probability of a safe touchdown can be trusted, beside the rules with thresholds."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import configuration, machine, table
from common.risk import flights
from common.rules import RULES, Judged, drawn, found_kept, judge, looks, swept
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from quadtree_lss.lab.campaign.study import parse_seeds
from quadtree_lss.lab.evaluation.metrics import scores
from quadtree_lss.lab.evaluation.risk_flights import CASES, Conditions, Mapped
from quadtree_lss.lab.simulation.hazard_field import FIELDS
from quadtree_lss.onboard.arrays import Array, Index, Mask
from quadtree_lss.onboard.config.risk import risk_model
from quadtree_lss.onboard.config.settings import Config

Flown = dict[str, list[list[Mapped]]]
All = dict[str, list[list[Judged]]]

BINS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3)
FOUND = 0.996
THRESHOLDS = np.geomspace(1e-4, 0.5, 120)
TIMES = (0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0)
FINE_TIMES = np.geomspace(0.6, 1.5, 40)  # what rises less is not told apart
RESAMPLED = 1000


class Sample(NamedTuple):
    """Risks, failures and numbers of the tiles of ground, (K,) each."""

    risk: Array
    failed: Mask
    tile: Index


def main() -> None:
    """Print the tables, draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--seeds", default="21000-21002", help="each flown in each case")
    add("--cases", default=",".join(CASES), help="of fields and noise")
    add("--terrain", type=Path, action="append", default=[], help=".npz; flown with rocks, without")
    add("--keep", type=Path, help="folder of the flights: taken from there if they are in it")
    add("--model", default="", help="file of fit-risk, by default the one of the package")
    add("--draws", type=int, default=40, help="terrains drawn from a map; 0 for none")
    add("--figure", type=Path, help="PNG to draw")
    options = parser.parse_args()
    print(machine())
    config, model = configuration("morpheus"), risk_model(options.model)
    cases = options.cases.split(",")
    flown = flights(cases, parse_seeds(options.seeds), config, options.terrain, options.keep)
    judged: All = {}
    for name, of_case in flown.items():
        own = CASES.get(name, Conditions()).mapping(config)
        judged[name] = [
            [judge(one, model, own, one is maps[-1]) for one in maps] for maps in of_case
        ]
    of_all = {
        name: sampled([(number, one) for number, maps in enumerate(of_case) for one in maps])
        for name, of_case in judged.items()
    }
    reliability_table(
        "Truly unsafe over predicted, by predicted risk in %", of_all | pooled(of_all)
    )
    score_table(judged)
    rules_table(flown, judged, config)
    sites_table(judged)
    looks_table(flown, config)
    if options.draws:
        two_ways(flown, judged, config, options.draws)
    if options.figure:
        draw(options.figure, of_all, flown, judged, config)


def joined(found: list[Judged]) -> tuple[Array, Mask]:
    """Risks and failures of several maps (K,)."""
    return np.concatenate([j.risk for j in found]), np.concatenate([j.failed for j in found])


def sampled(found: list[tuple[int, Judged]]) -> Sample:
    """Several maps, each with the number of its flight."""
    tiles = [1_000_000 * number + one.tile for number, one in found]
    return Sample(*joined([one for _, one in found]), np.concatenate(tiles))


def pooled(of_case: dict[str, Sample]) -> dict[str, Sample]:
    """What is alike taken together: the fields, the noise cases, the real terrains."""
    groups: dict[str, list[Sample]] = {"all fields": [], "all noise": [], "all terrains": []}
    for name, of in of_case.items():
        kind = "all terrains" if name not in CASES else "all noise"
        groups["all fields" if name in FIELDS else kind].append(of)
    out = {}
    for name, found in groups.items():
        if len(found) > 1:
            tile = np.concatenate([of.tile + 10**9 * k for k, of in enumerate(found)])
            risk, failed = (np.concatenate([one[k] for one in found]) for k in (0, 1))
            out[name] = Sample(risk, failed, tile)
    return out


def ratios(of: Sample) -> list[tuple[float, float, float]]:
    """Observed over predicted share in each of ``BINS``, and where 90 % of those lie that other
    tiles of such ground would give (bootstrap over the tiles); NaN of fewer than 100 points."""
    tiles, place = np.unique(of.tile, return_inverse=True)
    rng, out = np.random.default_rng(1), []
    times = rng.multinomial(len(tiles), np.full(len(tiles), 1.0 / len(tiles)), RESAMPLED)
    for low, high in zip(BINS, BINS[1:], strict=False):
        here = (of.risk >= low) & (of.risk < high)
        if here.sum() < 100:
            out.append((np.nan, np.nan, np.nan))
            continue
        failed, predicted = (
            np.bincount(place[here], weights[here], len(tiles)) for weights in (of.failed, of.risk)
        )
        with np.errstate(invalid="ignore"):
            others = (times @ failed) / (times @ predicted)
        least, most = np.nanpercentile(others, (5.0, 95.0))
        out.append((float(failed.sum() / predicted.sum()), float(least), float(most)))
    return out


def dashed(value: float, digits: str) -> str:
    """A number; a dash where there is none."""
    return "-" if np.isnan(value) else format(value, digits)


def reliability_table(title: str, rows: dict[str, Sample]) -> None:
    """A line for each case or way."""
    bins = [f"{100 * a:g}-{100 * b:g}" for a, b in zip(BINS, BINS[1:], strict=False)]
    lines = []
    for name, of in rows.items():
        numbers = [
            "-" if np.isnan(ratio) else f"{ratio:.2f} ({least:.2f}-{most:.2f})"
            for ratio, least, most in ratios(of)
        ]
        lines.append([name, *numbers, f"{of.risk.mean():.4f}", f"{of.failed.mean():.4f}"])
    table(title, ["case", *bins, "predicted", "unsafe"], lines)


def constant(called: Mask, failed: Mask) -> Array:
    """The best probabilities for a rule that knows but safe and unsafe: found afterwards."""
    out = np.empty(called.shape)
    for which in (called, ~called):
        out[which] = failed[which].mean() if which.any() else 0.5
    return out


def score_table(judged: All) -> None:
    """Brier and log scores of the last maps; the less the better."""
    lines = []
    for name, of_case in judged.items():
        last = [maps[-1] for maps in of_case]
        risk, failed = joined(last)
        found = {"probability": scores(risk, failed)}
        for rule in RULES[:2]:
            called = np.concatenate([one.called[rule] for one in last])
            found[rule] = scores(constant(called, failed), failed)
        numbers = [f"{found[rule][k]:.4f}" for k in (0, 1) for rule in RULES]
        lines.append([name, *numbers])
    header = [f"{score}, {rule}" for score in ("Brier", "log") for rule in RULES]
    title = "Scores after the flight; rules with the best constant for safe and unsafe afterwards"
    table(title, ["case", *header], lines)


def most_kept(curves: Array, limits: Array) -> tuple[float, float]:
    """The widest limit by which the worst flight finds ``FOUND``, and what it keeps in the mean;
    NaN if there is none.

    Args:
        curves: (N, T, 2) of ``found_kept`` for each flight and limit.
        limits: (T,) that ascend.
    """
    enough = np.flatnonzero(curves[:, :, 0].min(axis=0) >= FOUND)
    if not enough.size:
        return float("nan"), float("nan")
    return float(limits[enough[-1]]), float(curves[:, enough[-1], 1].mean())


def by_risk(last: list[Judged]) -> Array:
    """(N, T, 2) of ``found_kept`` at ``THRESHOLDS``."""
    return np.array([[found_kept(j.risk <= t, j.failed) for t in THRESHOLDS] for j in last])


def rules_table(flown: Flown, judged: All, config: Config) -> None:
    """Operating points as they are shipped, and those that find ``FOUND`` in the worst flight."""
    lines, gained = [], []
    for name, of_case in judged.items():
        last, row = [maps[-1] for maps in of_case], [name]
        for rule in RULES:
            found, kept = np.transpose([found_kept(j.called[rule], j.failed) for j in last])
            row += [f"{100 * found.mean():.2f} / {100 * found.min():.2f}"]
            row += [f"{100 * kept.mean():.1f}"]
        own = CASES.get(name, Conditions()).mapping(config)
        curves = np.array([swept(maps[-1], own, "touchdown", FINE_TIMES) for maps in flown[name]])
        times, theirs = most_kept(curves, FINE_TIMES)
        risk, ours = most_kept(by_risk(last), THRESHOLDS)
        gained.append(100.0 * (ours - theirs))
        row += [f"{dashed(times, '.2f')}: {dashed(100 * theirs, '.1f')}"]
        row += [f"{dashed(100 * risk, '.2f')}: {dashed(100 * ours, '.1f')}"]
        lines.append([*row, dashed(gained[-1], "+.1f")])
    header = [text for rule in RULES for text in (f"{rule}: found", "kept")]
    title = "Hazards found, mean / worst flight, and safe ground kept, %; by max_risk "
    title += f"{config.lss.max_risk:g}, and where the worst flight finds {100 * FOUND:g} %"
    at = ["touchdown's limits, times: kept", "risk, %: kept", "more"]
    lines.append(["mean", *[""] * (len(header) + 2), dashed(float(np.nanmean(gained)), "+.1f")])
    table(title, ["case", *header, *at], lines)


def sites_table(judged: All) -> None:
    """First sites."""
    lines = []
    for name, of_case in [*judged.items(), ("all", [m for c in judged.values() for m in c])]:
        row = [name]
        for rule in RULES:
            share = np.array([maps[-1].first[rule] for maps in of_case])
            some = share[~np.isnan(share)]
            middle = float(np.median(some)) if some.size else float("nan")
            row += [dashed(middle, ".2f"), f"{(some == 0.0).sum()} of {some.size}"]
        lines.append(row)
    header = [text for rule in RULES for text in (rule, "unsafe")]
    title = "First site's true clearance over the best to be had, median; unsafe first sites"
    table(title, ["case", *header], lines)


def looks_table(flown: Flown, config: Config) -> None:
    """Uncertain and bad ground after 65 % of the flights, and at their ends."""
    lines = []
    for name, of_case in flown.items():
        own = CASES.get(name, Conditions()).mapping(config)
        found = [looks(maps[-2], maps[-1], own) for maps in of_case if len(maps) > 1]
        row = [name]
        for kind in ("uncertain", "bad"):
            counts = np.sum([one[kind] for one in found], axis=0)
            total = max(int(counts[:3].sum()), 1)
            row += [f"{counts[:3].sum():,}", *(f"{100 * count / total:.0f}" for count in counts)]
        lines.append(row)
    then = ("then allowed", "uncertain", "bad", "truly unsafe")
    header = [text for kind in ("uncertain", "bad") for text in (kind, *then)]
    table(
        "Grid points after 65 % of the flight, and what became of them, %", ["case", *header], lines
    )


def two_ways(flown: Flown, judged: All, config: Config, draws: int) -> None:
    """The fit against terrains drawn from the map, after the first flight of each case."""
    rows, lines = {}, []
    for name, of_case in flown.items():
        own, one = CASES.get(name, Conditions()).mapping(config), judged[name][0][-1]
        by_draws = drawn(of_case[0][-1], own, draws, 1)
        rows[f"{name}, draws"] = Sample(by_draws, one.failed, one.tile)
        rows[f"{name}, fit"] = Sample(one.risk, one.failed, one.tile)
        pairs = [scores(by_draws, one.failed), scores(one.risk, one.failed)]
        lines.append([name, *[f"{pair[k]:.4f}" for k in (0, 1) for pair in pairs]])
    reliability_table(f"{draws} terrains drawn from the map against the fit, one flight", rows)
    table("Their scores", ["case", "Brier, draws", "fit", "log, draws", "fit"], lines)


def draw(file: Path, of_all: dict[str, Sample], flown: Flown, judged: All, c: Config):
    """Reliability of all cases, and what rules find and keep on the default field."""
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    edges = np.geomspace(3e-4, 0.9, 12)
    for name, of in of_all.items():
        risk, failed = of.risk, of.failed
        at = [(risk >= a) & (risk < b) for a, b in zip(edges, edges[1:], strict=False)]
        at = [here for here in at if here.sum() >= 300]
        x, y = [risk[here].mean() for here in at], [failed[here].mean() for here in at]
        left.plot(x, y, "-" if name in CASES else "--", marker=".", label=name, linewidth=1.0)
    left.plot(edges, edges, "k", linewidth=0.8)
    left.fill_between(edges, edges / 2.0, edges * 2.0, color="0.9", label="within a factor of 2")
    left.set(xscale="log", yscale="log", xlabel="predicted risk", ylabel="truly unsafe share")
    left.set(ylim=(1e-4, 1.0))
    left.legend(fontsize=7)
    shown = next(iter(judged))
    last = [maps[-1] for maps in judged[shown]]
    curves = {"probability": by_risk(last)}
    for rule in RULES[:2]:
        curves[rule] = np.array([swept(maps[-1], c, rule, TIMES) for maps in flown[shown]])
    for rule, values in curves.items():
        found, kept = values.mean(axis=0).T
        marker = "" if rule == "probability" else "."
        right.plot(100 * kept, 100 * np.maximum(1.0 - found, 1e-5), marker=marker, label=rule)
    right.set(yscale="log", xlabel="safe ground kept, %", ylabel="hazards missed, %")
    right.set(title=f"{shown}: limits swept", ylim=(5e-3, 20.0))
    right.legend()
    figure.savefig(file, dpi=100)


if __name__ == "__main__":
    main()
