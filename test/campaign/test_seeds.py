# SPDX-License-Identifier: Apache-2.0
"""Many seeds at once: flown, mapped, scored, and flown once only."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import shutil
import time
from concurrent.futures import BrokenExecutor

import pytest

from quadtree_lss.campaign import FlightOptions, evaluate_seeds, parse_seeds
from quadtree_lss.campaign.workers import workers
from quadtree_lss.config.loading import load_config
from quadtree_lss.evaluation import EvaluationError

FLIGHT = FlightOptions(scenario="parabola", duration=2.0)


@pytest.fixture(scope="module")
def config():
    return load_config(["parabola"])


@pytest.fixture(scope="module")
def run(tmp_path_factory, config):
    steps = []
    out = tmp_path_factory.mktemp("many")
    result = evaluate_seeds(
        [4, 5], out, config, FLIGHT, jobs=1, progress=lambda done, of: steps.append((done, of))
    )
    return result, steps


@pytest.mark.parametrize(
    ("text", "seeds"),
    [("7", [7]), ("101-103", [101, 102, 103]), ("5,1-2,9", [5, 1, 2, 9]), (" 3 - 4 ", [3, 4])],
)
def test_lists_of_seeds(text, seeds):
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize(
    "text", ["", "a", "1-", "5-3", "1,,2", "-4", "1.5", "0-99999999", "1,1", "5,4-6"]
)
def test_what_is_no_list_of_seeds_is_named(text):
    with pytest.raises(EvaluationError, match="seeds"):
        parse_seeds(text)


def test_every_seed_is_scored_and_progress_told(run):
    result, steps = run
    assert list(result.scored) == [4, 5]
    assert not result.failed
    assert steps == [(k, 6) for k in range(7)]
    assert (result.out / "seeds.png").read_bytes().startswith(b"\x89PNG")


def test_files_hold_what_the_result_holds(run):
    result, _ = run
    content = json.loads((result.out / "evaluation.json").read_text())
    assert content["summary"]["safe_found"]["mean"] == result.summary["safe_found"].mean
    assert set(content["seeds"]) == {"4", "5"}
    with (result.out / "evaluation.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["seed"] for row in rows] == ["4", "5"]
    found = result.scored[5].detection.hazardous_found
    assert float(rows[1]["hazardous_found"]) == pytest.approx(100.0 * found, abs=1e-6)


def test_table_shows_mean_worst_and_the_seed(run):
    result, _ = run
    table = result.table()
    for word in ("mean", "95 % interval", "worst", "2 seeds of parabola", "Truly unsafe sites"):
        assert word in table
    assert len({len(line) for line in table.splitlines()[:-2]}) == 1


def test_one_seed_has_no_interval(run):
    whole, _ = run
    one = dataclasses.replace(whole, scored={4: whole.scored[4]})
    table = one.table()
    assert "…" not in table and "nan" not in table
    assert "1 seed of parabola" in table
    assert one.as_dict()["summary"]["safe_found"]["low"] is None


def test_flights_made_with_the_same_options_are_used_again(run, tmp_path, config):
    result, _ = run
    flights = result.out / "flights"
    bag = next((flights / "parabola_4" / "bag").glob("*.mcap"))
    before = bag.stat().st_mtime_ns
    again = evaluate_seeds([4], tmp_path / "again", config, FLIGHT, bags=flights, jobs=1)
    assert bag.stat().st_mtime_ns == before
    assert again.scored[4].detection == result.scored[4].detection
    shutil.copytree(flights, tmp_path / "flights")
    moved = next((tmp_path / "flights" / "parabola_4" / "bag").glob("*.mcap"))
    old = moved.read_bytes()
    other = FlightOptions(scenario="parabola", duration=2.0, dropouts=0.5)
    evaluate_seeds([4], tmp_path / "else", config, other, bags=tmp_path / "flights", jobs=1)
    assert moved.read_bytes() != old


def test_two_processes_find_the_same(run, tmp_path, config):
    result, _ = run
    both = evaluate_seeds([4, 5], tmp_path, config, FLIGHT, bags=result.out / "flights", jobs=2)
    assert list(both.scored) == [4, 5]
    for seed in (4, 5):
        assert both.scored[seed].detection == result.scored[seed].detection
        assert both.scored[seed].elevation == result.scored[seed].elevation


def test_one_bad_flight_does_not_spoil_the_others(run, tmp_path, config):
    result, _ = run
    shutil.copytree(result.out / "flights", tmp_path / "flights")
    (tmp_path / "flights" / "parabola_4" / "truth.npz").write_bytes(b"rubbish")
    part = evaluate_seeds(
        [4, 5], tmp_path / "out", config, FLIGHT, bags=tmp_path / "flights", jobs=1
    )
    assert list(part.scored) == [5]
    assert "truth.npz" in part.failed[4]
    assert "seed 4 failed" in part.table()
    with pytest.raises(EvaluationError, match="seed 4"):
        evaluate_seeds([4], tmp_path / "x", config, FLIGHT, bags=tmp_path / "flights", jobs=1)


def test_stopping_keeps_the_seeds_that_were_scored(run, tmp_path, config):
    result, _ = run
    done = [0]
    part = evaluate_seeds(
        [4, 5],
        tmp_path,
        config,
        FLIGHT,
        bags=result.out / "flights",
        jobs=1,
        progress=lambda steps, of: done.__setitem__(0, steps),
        stop=lambda: done[0] >= 3,
    )
    assert part.interrupted and list(part.scored) == [4] and not part.failed
    assert json.loads((tmp_path / "evaluation.json").read_text())["interrupted"]
    with pytest.raises(KeyboardInterrupt):
        evaluate_seeds([4], tmp_path / "x", config, FLIGHT, jobs=1, stop=lambda: True)


def _vanish(_):
    os._exit(9)


def test_a_process_that_is_killed_is_told_and_ends_nothing_else():
    with workers(2) as (start, _):
        assert start(abs, -3).result() == 3
        with pytest.raises(BrokenExecutor):
            start(_vanish, None).result()


def test_workers_are_ended_in_the_middle_of_their_work():
    with workers(2) as (start, end):
        futures = [start(abs, -1), start(time.sleep, 3600)]
        assert futures[0].result() == 1
        while not futures[1].running():
            time.sleep(0.01)
        end()
        with pytest.raises((SystemExit, BrokenExecutor)):
            futures[1].result()


def test_the_configuration_lies_beside_the_scores(run, config):
    result, _ = run
    assert load_config([str(result.out / "config.yaml")]) == config


def test_nothing_to_do_and_nowhere_to_write(tmp_path, config):
    with pytest.raises(EvaluationError, match="seed"):
        evaluate_seeds([], tmp_path, config, FLIGHT)
    with pytest.raises(EvaluationError, match="jobs"):
        evaluate_seeds([1], tmp_path, config, FLIGHT, jobs=3)
    (tmp_path / "file").write_text("")
    with pytest.raises(EvaluationError, match="cannot create"):
        evaluate_seeds([1], tmp_path / "file" / "out", config, FLIGHT)
