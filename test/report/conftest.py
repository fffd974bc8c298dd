# SPDX-License-Identifier: Apache-2.0
"""One replay for all tests of its page."""

from functools import partial

import pytest
from replay.recordings import GROUND, write_ros2

from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.onboard.config.settings import config_from_values


@pytest.fixture(scope="session")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    return replay(write_ros2(folder / "bag"), folder / "out", config_from_values(GROUND))


@pytest.fixture(scope="session")
def text(result):
    return (result.out / "report.html").read_text()


@pytest.fixture
def browse(text, in_browser):
    """Of some steps on the page, what a browser tells."""
    return partial(in_browser, text)
