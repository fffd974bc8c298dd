# SPDX-License-Identifier: Apache-2.0
"""The page of a campaign: its answer, and a point for each flight."""

import re

import numpy as np
import pytest
from report.pages import Page, accessible, in_a_browser, sheets

from quadtree_lss.lab.campaign.kinds import Record
from quadtree_lss.lab.campaign.study import read_study
from quadtree_lss.lab.campaign.summary import CampaignResult, page

COUNT, BAD = 40, 7


@pytest.fixture
def result(tmp_path):
    """Flights straight down and by the nodes; one of them, by the nodes, is unsafe."""
    study = tmp_path / "study.yaml"
    study.write_text("kind: fly\nscenario: [package, none]\nseed: 1\nflights: 20\n")
    records = {}
    for k in range(COUNT):
        scenario = ("package", "none")[k % 2]
        figures = {"safe": int(k != BAD - 1), "unsafe": int(k == BAD - 1), "one": 1, "aborted": 0}
        figures |= {"propellant": 60.0 + k, "from_planned": float(k % 9), "error": None}
        labels = {"scenario": scenario}
        records[k] = Record(k, 10**15 + k, scenario, labels, figures)
    return CampaignResult(tmp_path / "out", read_study(study), records)


def test_the_answer_comes_first_and_every_flight_is_in_it(result):
    text = page(result)
    found = Page(text)
    first, second = re.findall(r'<p class="verdict (\w*)">(.*?)</p>', text)
    assert first[0] == "none" and second[0] == "good"
    assert "scenario package: Safe touchdowns 19 of 20, 95 %: 75.13 … 99.87 %." in first[1]
    assert text.index("19 of 20") < text.index("<canvas") < text.index("<table")
    data = found.data
    np.testing.assert_allclose(found.column(data["columns"]["propellant"]), 60.0 + np.arange(COUNT))
    assert np.isnan(found.column(data["columns"]["error"])).all()
    assert data["indices"] == list(range(COUNT)) and data["seeds"][3] == "1000000000000003"
    assert [k for k, bad in enumerate(data["bad"]) if bad] == [BAD - 1]


@in_a_browser
def test_a_click_on_a_flight_shows_its_command(result, in_browser):
    told = in_browser(
        page(result),
        """
        const axis = (name, value) => { const s = byId(`axis-${name}`); s.value = value;
          s.dispatchEvent(new Event("change")); };
        tellTest("axes", [...byId("axis-x").options].map(o => o.value));
        axis("x", "propellant"); axis("y", "from_planned");
        const click = k => { const [x, y] = places()[k], box = canvas.getBoundingClientRect();
          const there = { clientX: box.left + x, clientY: box.top + y };
          canvas.dispatchEvent(new MouseEvent("click", there));
          return [chosen.flight, byId("flight").querySelector("code").textContent]; };
        tellTest("clicked", [3, 20].map(click));
        document.querySelector("button[data-flight]").click();
        tellTest("worst", chosen.flight);
        const number = byId("number"); number.value = 5; number.dispatchEvent(new Event("change"));
        tellTest("number", [chosen.flight, location.hash]);
        tellTest("wide", root.scrollWidth <= innerWidth);
        """,
    )
    assert {"propellant", "from_planned", "safe"} <= set(told["axes"])
    assert "error" not in told["axes"]  # no flight has it
    assert [flight for flight, _ in told["clicked"]] == [3, 20]
    assert told["clicked"][1][1].endswith("--keep 20")
    assert told["worst"] == BAD - 1 and told["wide"]
    assert told["number"] == [5, "#x=propellant&y=from_planned&flight=5"]


@in_a_browser
@pytest.mark.slow
def test_it_can_be_used_by_all_and_prints_on_two_sheets(result, in_browser):
    assert accessible(in_browser, page(result)) and 1 <= sheets(in_browser, page(result)) <= 2
