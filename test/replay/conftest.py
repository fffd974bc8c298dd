# SPDX-License-Identifier: Apache-2.0
"""A short flight for the tests that only read it, and which tests of the doctor are quick."""

import pytest
from replay.recordings import write_ros2

#: Of test_doctor.py, whose flights take seconds each: names and parameters that are not slow.
QUICK = (
    "test_a_damaged_bag_is_not_called_sound",
    "test_each_fault_is_found_with_its_fix[a forgotten mount]",
    "test_each_fault_is_found_with_its_fix[clouds FLU, poses optical]",
    "test_each_fault_is_found_with_its_fix[clouds in mm]",
    "test_each_fault_is_found_with_its_fix[clouds of a clock 37 s ahead]",
    "test_nothing_is_wrong_with_a_good_flight[poses of the lidar]",
)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    for item in items:
        if item.path.name == "test_doctor.py" and "replay" in item.path.parts:
            if item.name not in QUICK:
                item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="session")
def bag(tmp_path_factory):
    return write_ros2(tmp_path_factory.mktemp("flight") / "bag", scans=6)
