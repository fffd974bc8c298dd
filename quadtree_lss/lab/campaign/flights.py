# SPDX-License-Identifier: Apache-2.0
"""Kinds of flights: ``map`` simulates, maps and scores in memory; ``fly`` lands in lock-step."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

from quadtree_lss.desk.bags.bag import MessageBag, Topic
from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.desk.replay.files import plain
from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.lab.campaign.kinds import Case, Figures, Kind, Quantity
from quadtree_lss.lab.evaluation.evaluate import EvaluationResult, evaluate, score
from quadtree_lss.lab.evaluation.results import Results, Truth, results_of, truth_of
from quadtree_lss.lab.evaluation.risk_flights import lander_of
from quadtree_lss.lab.flight import fly as lockstep
from quadtree_lss.lab.flight.flight_page import write_flight
from quadtree_lss.lab.flight.settings import AVOIDANCE, FlightSettings, flight_settings
from quadtree_lss.lab.simulation.lidar import StereoCamera
from quadtree_lss.lab.simulation.recording import CLOUD, DEPTH_TYPES, POSE, POSE_TOPIC, SCAN_TOPIC
from quadtree_lss.lab.simulation.scenarios import SCENARIOS, Conditions
from quadtree_lss.lab.simulation.simulate import Simulation, simulate
from quadtree_lss.onboard.config.settings import Config

LANDING_CONDITIONS = "terrain rocks range_noise outliers dropouts half".split()
LANDING_CONDITIONS += "slant_range speed glide_slope_deg scatter survey fault".split()


def fly_map(case: Case) -> Figures:
    config = load_config([], case.parameters)
    results, truth = fly_in_memory(case.scenario, case.seed, config, case.conditions)
    return figures(score(results, truth), results, truth)


def in_memory(simulation: Simulation) -> MessageBag:
    """A simulated flight as a bag in memory that can be read once."""
    legs = simulation.legs
    scans, poses = sum(len(leg.scan_ns) for leg in legs), sum(len(leg.pose_ns) for leg in legs)
    depth = isinstance(legs[0].plan.lidar, StereoCamera)
    kinds = DEPTH_TYPES if depth else {SCAN_TOPIC: CLOUD}
    topics = [Topic(name, kind, scans) for name, kind in kinds.items()]
    topics.append(Topic(POSE_TOPIC, POSE, poses))
    span_ns = legs[0].arrivals[0][0], legs[-1].arrivals[-1][0]
    return MessageBag("bag", topics, span_ns, simulation.messages())


def fly_in_memory(
    scenario: str, seed: int, config: Config, conditions: Any
) -> tuple[Results, Truth]:
    """Results and truth of a simulated flight, bit-identical to those from a recorded bag."""
    simulation = Simulation(scenario, seed, **conditions)
    results = results_of(replay(in_memory(simulation), None, config, report=False))
    return results, truth_of(simulation.truth(lander_of(config)))


def figures(scores: EvaluationResult, results: Results, truth: Truth) -> Figures:
    detection, elevation = scores.detection, scores.elevation
    known = [verdict for verdict in scores.site_verdicts if verdict != "unknown"]
    found = {
        "hazardous_found": 100.0 * detection.hazardous_found,
        "safe_found": 100.0 * detection.safe_found,
        "precision": 100.0 * detection.precision,
        "unseen_box": 100.0 * detection.unseen_box,
        "missed_depth": detection.missed_depth,
        "sites": scores.sites,
        "unsafe_in_top_five": scores.unsafe_in_top_five,
        "judged_in_top_five": len(known),
        "unsafe_first": int(scores.site_verdicts[:1] == ("unsafe",)),
        "judged_first": int(bool(scores.site_verdicts) and scores.site_verdicts[0] != "unknown"),
        "without_site": int(not scores.sites),
        "one": 1,
        "doubted": int(bool(results.summary["doubts"])),
        "rms_mean_removed": elevation.rms_mean_removed,
        "mean_absolute": elevation.mean_absolute,
        "maximum": elevation.maximum,
        "leaves": scores.leaves_estimated,
        "scans": int(results.timing["stamp_ns"].size),
        "noise_ratio": results.summary["range_noise_ratio"],
        "truly_safe": 100.0 * float(truth.safe.mean()),
        "brier": None if scores.risk is None else scores.risk.brier,
    }
    return plain(found)


def keep_map(case: Case, folder: Path) -> None:
    config, given = load_config([], case.parameters), dict[str, Any](case.conditions)
    given |= {"seed": case.seed, "overwrite": True, "lander": lander_of(config)}
    simulate(case.scenario, folder / "bag", **given)
    replay(folder / "bag", folder / "results", config)
    evaluate(folder / "results", folder / "truth.npz", folder / "evaluation")


MAP = Kind(
    fly=fly_map,
    keep=keep_map,
    scenarios=tuple(SCENARIOS),
    conditions=tuple(item.name for item in fields(Conditions)),
    quantities=(
        Quantity("hazardous_found", "Hazardous terrain found", "%", 2, "smallest"),
        Quantity("safe_found", "Safe terrain found", "%", 1, "smallest"),
        Quantity("precision", "Ground called safe that is", "%", 2, "smallest"),
        Quantity("unsafe_in_top_five", "Unsafe sites in the top five", of="judged_in_top_five"),
        Quantity("unsafe_first", "Unsafe first site", of="judged_first"),
        Quantity("without_site", "Flights without a site", of="one"),
        Quantity("doubted", "Flights with warnings about their risks", of="one"),
        Quantity("brier", "Brier score of the risk", "", 4),
        Quantity("rms_mean_removed", "Elevation RMS, mean removed", "m", 4),
        Quantity("mean_absolute", "Elevation error, mean absolute", "m", 4),
        Quantity("maximum", "Elevation error, largest", "m", 2),
        Quantity("missed_depth", "Deepest missed grid point", "m", 2),
        Quantity("unseen_box", "Scanned box out of the score", "%", 2),
        Quantity("leaves", "Leaves with an estimate", "", 0),
        Quantity("truly_safe", "Truly safe ground", "%", 1, "smallest"),
    ),
)


def settings_of(case: Case) -> FlightSettings:
    """Settings of a case, whose scenario is the avoidance."""
    given: dict[str, Any] = dict(case.conditions)
    fault = given.pop("fault", None)
    given |= {"avoidance": case.scenario, "config": dict(case.parameters)}
    given["faults"] = (str(fault),) if fault else ()
    given["terrain"] = given.get("terrain") or ""
    return flight_settings(given)


def fly_landing(case: Case) -> Figures:
    found = lockstep.fly_lockstep(case.seed, settings_of(case)).figures
    down = found["outcome"] == "touchdown"
    return {
        **{k: int(v) if isinstance(v, bool) else v for k, v in found.items() if k != "seed"},
        "one": 1,
        "doubted": int(bool(found["warnings"])),
        "aborted": int(not down),
        "unsafe": int(down and not found["safe"]),
        "from_planned": found["from_planned"] if down else None,
        "unsafe_known": int(down and not found["ground_safe"] and found["map_said"] == "unsafe"),
    }


def keep_landing(case: Case, folder: Path) -> None:
    write_flight(folder, lockstep.fly_lockstep(case.seed, settings_of(case), record=True))


FLY = Kind(
    fly=fly_landing,
    keep=keep_landing,
    scenarios=AVOIDANCE,
    conditions=LANDING_CONDITIONS,
    quantities=(
        Quantity("safe", "Safe touchdowns", worst="smallest", of="one"),
        Quantity("unsafe", "Unsafe touchdowns", of="one"),
        Quantity("aborted", "Flights without touchdown", of="one"),
        Quantity("doubted", "Flights with warnings about their risks", of="one"),
        Quantity("unsafe_known", "Unsafe where the map had said so", of="one"),
        Quantity("error", "Touchdown from the aim", "m", 3),
        Quantity("from_planned", "Touchdown from the planned point", "m", 1),
        Quantity("propellant", "Propellant", "kg", 1),
        Quantity("diverts", "Diverts after the first target", "", 1),
        Quantity("last_divert_height", "Height of the last divert", "m", 1, "smallest"),
        Quantity("last_divert_time", "Time of the last divert", "s", 1),
        Quantity("time", "Time of flight", "s", 1),
    ),
)
