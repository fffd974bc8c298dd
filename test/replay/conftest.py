# SPDX-License-Identifier: Apache-2.0
"""One short flight for all tests that only read it."""

import pytest
from replay.recordings import write_ros2


@pytest.fixture(scope="session")
def bag(tmp_path_factory):
    return write_ros2(tmp_path_factory.mktemp("flight") / "bag", scans=6)
