# SPDX-License-Identifier: Apache-2.0
"""The table of parameters: ranges, nearest keys, contradictions, round trips."""

import dataclasses
import math
import re

import pytest

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.onboard.config.settings import (
    REMOVED,
    Config,
    ConfigError,
    Parameter,
    config_from_values,
    parameters,
    values_from_config,
)

ROWS = parameters()


def named(rows: list[Parameter]) -> dict[str, object]:
    return {"argvalues": rows, "ids": [row.name for row in rows]}


def test_names_are_unique_and_have_a_section():
    names = [row.name for row in ROWS]
    assert len(set(names)) == len(names)
    assert all(name.count(".") == 1 for name in names)


@pytest.mark.parametrize("row", **named(list(ROWS)))
def test_defaults_have_type_range_and_meaning(row):
    assert type(row.default) is row.type
    assert row.doc
    if row.type in (int, float):
        assert row.low <= row.default <= row.high
        assert math.isfinite(row.low)
        assert math.isfinite(row.high)
    if row.choices:
        assert row.default in row.choices
    assert config_from_values({row.name: row.default}) == Config()


def impossible(row: Parameter) -> list[object]:
    """Return values of a wrong type, out of range, or not among the choices."""
    values: list[object] = [
        {bool: 1, int: 1.5, float: "1.0", str: 3}[row.type],
        None,
        [row.default],
    ]
    if row.type is not bool:
        values.append(True)
    if row.type in (int, float):
        step = 1 if row.type is int else max(abs(row.high), 1.0) * 1e-3
        values += [row.type(row.low - step), row.type(row.high + step)]
    if row.type is float:
        values += [math.nan, math.inf, -math.inf]
    return values + ["no such choice"] * bool(row.choices)


@pytest.mark.parametrize("row", **named(list(ROWS)))
def test_invalid_values_are_rejected_by_name(row):
    for value in impossible(row):
        with pytest.raises(ConfigError, match=row.name.replace(".", r"\.")) as caught:
            config_from_values({row.name: value})
        if row.choices and isinstance(value, str):
            assert all(choice in str(caught.value) for choice in row.choices)


def test_integers_are_accepted_for_floats():
    assert config_from_values({"domain.size": 64}).domain.size == 64.0
    assert isinstance(config_from_values({"domain.size": 64}).domain.size, float)


@pytest.mark.parametrize("key", REMOVED)
def test_removed_name_is_an_error_with_its_replacement(key):
    assert key not in {row.name for row in ROWS}
    text = re.escape(f"{key} was removed: {REMOVED[key]}")
    for wrong in (lambda: config_from_values({key: 1.0}), lambda: load_config([], {key: 1.0})):
        with pytest.raises(ConfigError, match=text):
            wrong()


def test_derived_parameters():
    config = config_from_values({"pose.max_wait": 3.0, "diagnostics.warn_age": 0.5})
    assert (config.pose.queue, config.diagnostics.error_age) == (60, 2.5)
    assert (Config().pose.queue, Config().diagnostics.error_age) == (20, 5.0)


@pytest.mark.parametrize("key", ["domain", "", "domain.", "x.y.z", "lss.sites.more"])
def test_malformed_keys_are_configuration_errors(key):
    with pytest.raises(ConfigError):
        config_from_values({key: 3})


@pytest.mark.parametrize(
    ("values", "about"),
    [
        ({"domain.min_level": 6, "domain.max_level": 5}, "domain.min_level"),
        ({"domain.min_level": 4, "mapping.max_cells": 255}, "mapping.max_cells"),
        ({"frames.map": ""}, "frames.map"),
        ({"lidar.min_range": 10.0, "lidar.max_range": 10.0}, "lidar.min_range"),
        ({"domain.size": 50_000.0, "lss.grid_spacing": 0.1}, "lss.grid_spacing"),
        ({"domain.max_level": 12}, "domain.max_level"),
        ({"domain.max_level": 11, "domain.size": 2000.0}, "GB for an assessment"),
        ({"domain.max_level": 11, "lss.grid_spacing": 0.1}, "vehicle.diameter"),
        ({"domain.max_level": 11, "domain.size": 900.0, "lss.sites": 1000}, "lss.sites"),
    ],
)
def test_contradictions_are_found(values, about):
    with pytest.raises(ConfigError, match=about.replace(".", r"\.")):
        config_from_values(values)


def other_value(row: Parameter) -> object:
    """Return a valid value that is not the default."""
    if row.type is bool:
        return not row.default
    if row.type is str:
        return next((c for c in row.choices if c != row.default), "other")
    if row.type is int:
        return row.default + 1 if row.default < row.high else row.default - 1
    return row.default * 0.99 if row.default else min(row.high, 0.5)


def test_lengths_derive_from_the_vehicle_unless_set():
    """Vehicles with half the diameter and a third of the clearance, one with a set gap."""
    usual, lander = Config(), {"vehicle.diameter": 1.85, "vehicle.clearance": 0.1}
    half, own = config_from_values(lander), config_from_values({**lander, "lss.max_gap": 0.0})
    assert (usual.lss.gap, usual.lss.spacing) == (0.6, 0.5)
    assert (half.lss.gap, half.lss.spacing) == (0.3, 0.25)
    apart = [config.vehicle.lengths.min_separation for config in (usual, half)]
    assert apart == [3.7, 1.85]
    assert (own.lss.gap, own.lss.spacing) == (0.0, 0.25)
    third = {"feature_height": 3.0, "rock_area": 9.0, "feature_volume": 27.0, "max_gap": 2.0}
    for name, factor in third.items():
        at_first = getattr(usual.vehicle.lengths, name)
        assert getattr(half.vehicle.lengths, name) == pytest.approx(at_first / factor)
    assert config_from_values({}, half).lss == half.lss
    assert dataclasses.replace(half, vehicle=usual.vehicle) == usual


def test_outlier_gate_derives_from_vehicle_and_scan_type():
    """It is 4/3 of the least hazard, and 0 for depth images."""
    drone = config_from_values({"vehicle.diameter": 0.6, "vehicle.clearance": 0.06})
    assert Config().lidar.outlier_gate == 0.4
    assert drone.lidar.outlier_gate == pytest.approx(0.08)
    assert config_from_values({"lidar.source": "depth"}, drone).lidar.outlier_gate == 0.0
    assert config_from_values({"lidar.source": "points"}, drone) == drone


@pytest.mark.parametrize("row", **named(list(ROWS)))
def test_each_value_round_trips_dotted_and_nested(row):
    value = other_value(row)
    section, name = row.name.split(".")
    base = Config()
    for form in ({row.name: value}, {section: {name: value}}):
        config = config_from_values(form, base)
        values = values_from_config(config)
        assert values[row.name] == value
        assert config_from_values(values) == config
        assert [k for k in values if values[k] != values_from_config(base)[k]] == [row.name]
