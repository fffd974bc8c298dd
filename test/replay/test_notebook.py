# SPDX-License-Identifier: Apache-2.0
"""Tables of sites, for notebooks and pandas."""

import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from replay.recordings import GROUND

from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.onboard.config.settings import config_from_values


@pytest.fixture(scope="module")
def result(bag):
    return replay(bag, config=config_from_values(GROUND))


def test_notebooks_show_rank_position_and_probability_of_each_site(result):
    sites = result.assessment.sites
    assert len(sites) > 1
    rows = re.findall("<tr>(.*?)</tr>", result._repr_html_())
    names, *values = [re.findall("<td>(.*?)</td>", row) for row in rows]
    values = dict(zip(names, np.array(values).T, strict=True))
    np.testing.assert_array_equal(values["rank"].astype(int), np.arange(1, len(sites) + 1))
    positions = np.column_stack([values[axis].astype(float) for axis in "xyz"])
    np.testing.assert_allclose(positions, sites.position, atol=6e-5)
    np.testing.assert_allclose(values["probability"].astype(float), sites.probability, atol=6e-5)


def test_a_dataframe_has_rank_position_and_probability_of_each_site(result, monkeypatch):
    """Use dict as a data frame, because pandas is not installed."""
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=dict))
    sites = result.assessment.sites
    frame = sites.to_dataframe()
    np.testing.assert_array_equal(frame["rank"], np.arange(1, len(sites) + 1))
    np.testing.assert_array_equal(np.column_stack([frame[axis] for axis in "xyz"]), sites.position)
    np.testing.assert_array_equal(frame["probability"], sites.probability)
