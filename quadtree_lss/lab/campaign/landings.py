# SPDX-License-Identifier: Apache-2.0
"""The kind ``fly``: landings in closed loop, flown in lock-step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from quadtree_lss.lab.campaign.kinds import Case, Figures, Kind, Quantity
from quadtree_lss.lab.flight import fly as lockstep
from quadtree_lss.lab.flight.settings import AVOIDANCE, FlightSettings, flight_settings

CONDITIONS = "terrain rocks range_noise outliers dropouts half".split()
CONDITIONS += "slant_range speed glide_slope_deg scatter survey fault".split()


def settings_of(case: Case) -> FlightSettings:
    """Settings of a case, whose scenario is the avoidance."""
    given: dict[str, Any] = dict(case.conditions)
    fault = given.pop("fault", None)
    given |= {"avoidance": case.scenario, "config": dict(case.parameters)}
    given["faults"] = (str(fault),) if fault else ()
    given["terrain"] = given.get("terrain") or ""
    if "rocks" in given:
        given["rock_abundance"] = given.pop("rocks")
    return flight_settings(given)


def fly(case: Case) -> Figures:
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


def keep(case: Case, folder: Path) -> None:
    from quadtree_lss.lab.flight.flight_page import write_flight

    write_flight(folder, lockstep.fly_lockstep(case.seed, settings_of(case), record=True))


FLY = Kind(
    fly=fly,
    keep=keep,
    scenarios=AVOIDANCE,
    conditions=CONDITIONS,
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
