# SPDX-License-Identifier: Apache-2.0
"""The page of a flight: the report of its map with the path, diverts, faults and touchdown."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from quadtree_lss.desk.exchange.saved import Results, load_results
from quadtree_lss.desk.replay.files import write_bytes, write_csv, write_json, write_npz
from quadtree_lss.desk.replay.results import ReplayResult, run_summary, write_results
from quadtree_lss.desk.report import palette
from quadtree_lss.desk.report.headline import verdict
from quadtree_lss.desk.report.page_data import Layer
from quadtree_lss.desk.report.pages import Columns
from quadtree_lss.desk.report.report import page
from quadtree_lss.lab.flight.flight import START_NS
from quadtree_lss.lab.flight.fly import FlightResult, flight_config
from quadtree_lss.lab.flight.ground import Ground
from quadtree_lss.lab.flight.pilot import Decision
from quadtree_lss.lab.simulation.safety import LANDER, on_dem, safety_map


def write_flight(out: Path, flown: FlightResult) -> None:
    """Write the figures, samples and decisions of a flight. If it has a map, also write the results
    of a replay and the page. Raises `OSError`: ``out`` cannot be written."""
    write_json(out / "touchdown.json", flown.figures)
    flight = flown.flight
    _write_csv(out / "flight.csv", flight.samples[0]._fields, flight.samples)
    _write_csv(out / "decisions.csv", Decision._fields, flight.pilot.decisions)
    if flown.cells is not None and flown.last is not None:
        write_bytes(out / "flight.html", _page(_write_map(out, flown), flown).encode())


def headline(flown: FlightResult) -> str:
    """Describe the outcome of a flight in one line."""
    f = flown.figures
    if f["outcome"] != "touchdown":
        return f"seed {f['seed']}: {f['outcome']} after {f['time']:.1f} s"
    ground = "safe" if f["safe"] else "UNSAFE"
    return (
        f"seed {f['seed']}: {ground} touchdown after {f['time']:.1f} s,"
        f" {f['from_planned']:.1f} m from the planned point, {f['error']:.2f} m from the aim,"
        f" {f['propellant']:.1f} kg of propellant"
    )


def _page(content: Results, flown: FlightResult) -> str:
    flight, figures = flown.flight, flown.figures
    down = figures["outcome"] == "touchdown"
    words, _, ground = headline(flown).partition(": ")[2].partition(" after ")
    words += " at x {x:.2f}, y {y:.2f} m".format(**figures) if down else ""
    last = verdict(content)
    return page(
        content,
        _truth_layers(content, flight.ground),
        "lab/flight/flight.html",
        extra_data=lambda data, columns: {"flight": _flight_data(data, columns, flown)},
        title=f"Flight, seed {figures['seed']}",
        answer=f"{words[:1].upper()}{words[1:]}.",
        ground=f"After {ground}. The last assessment: {last.answer} {last.ground}",
        level="good" if down and figures["safe"] else "none",
        decisions=[
            (f"{d.time:.1f}", f"{d.height:.1f}", d.what, f"{d.x:.2f}", f"{d.y:.2f}")
            for d in flight.pilot.decisions
        ],
        targets=[
            (f"{1e-9 * (t.stamp_ns - START_NS):.1f}", t.reason, f"{t.x:.2f}", f"{t.y:.2f}")
            for t in flown.targets
        ],
        figures=[
            (name.replace("_", " "), f"{value:.4g}" if isinstance(value, float) else value)
            for name, value in sorted(figures.items())
        ],
    )


def _write_map(out: Path, flown: FlightResult) -> Results:
    """Write the map of the flight as the results of a replay; return them."""
    flight, cells, last = flown.flight, flown.cells, flown.last
    assert cells is not None and last is not None
    config = flight_config(flight.settings, flight.ground)
    bag = f"flight of seed {flown.figures['seed']}"
    summary = run_summary(cells, last, config, bag=bag, duration=flight.time, **flown.summary)
    result = ReplayResult(out, cells, last, (), summary, flown.targets)
    write_results(out, result, config, False, flown.history)
    if flown.history is not None:
        write_npz(out / "history.npz", flown.history.arrays())
    return load_results(out)


def _truth_layers(content: Results, ground: Ground) -> tuple[Layer, Layer]:
    """Layers of the true elevation and of the true safety at the grid points."""
    x, y = content.grid["x"], content.grid["y"]
    true = ground.terrain.elevation_at(*np.meshgrid(x, y))
    points = np.stack(np.meshgrid(x, y), axis=-1)
    known, safe = on_dem(ground.terrain, points, LANDER), safety_map(ground.terrain, x, y)
    stands = np.where(known, np.where(safe, 0, 1), 2).astype(np.uint8)
    limits = palette.colour_limits(true[content.grid.seen] if content.grid.seen.any() else true)
    words = (
        ("stands", palette.SAFE_COLOUR),
        ("falls", palette.EXCLUDED_COLOUR),
        ("beyond", palette.UNSEEN_COLOUR),
    )
    return (
        Layer("truth", "True elevation", true, "m", limits=limits),
        Layer("stands", "Where a lander stands, in truth", stands, classes=words),
    )


def _flight_data(data: dict[str, Any], columns: Columns, flown: FlightResult) -> dict[str, Any]:
    """Return the data of the flight for ``flight.js``; times since its start, s."""
    flight, names = flown.flight, ("time", "x", "y", "z")
    rows = np.array([[getattr(s, name) for name in names] for s in flight.samples])
    first = (data["history"] or {}).get("first_ns", START_NS)
    return {
        "before": 1e-9 * (first - START_NS),
        **{name: columns.floats(column) for name, column in zip(names, rows.T, strict=True)},
        "decisions": [list(d) for d in flight.pilot.decisions],
        "faults": flight.failed,
        "areas": [[time, area.round(2).tolist()] for time, area in flight.areas],
        "planned": flight.ground.planned.tolist(),
        "aim": flight.pilot.aim.tolist(),
        "down": flown.figures["outcome"] == "touchdown",
    }


def _write_csv(path: Path, header: Any, rows: Any) -> None:
    texts = ([f"{v:.6g}" if isinstance(v, float) else v for v in row] for row in rows)
    write_csv(path, header, texts)
