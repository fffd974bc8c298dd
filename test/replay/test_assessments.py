# SPDX-License-Identifier: Apache-2.0
"""Landing assessments in a bag's time: on which maps, and that no others are taken."""

from dataclasses import replace

import pytest
from core.builders import configured, flat, mapped

from quadtree_lss.desk.replay.assessments import Assessments

MS = 1_000_000
START = 1_000_000 * MS


class Answers:
    """Notes which map each answer is of; as a recorder does, it may take every map."""

    def __init__(self, every_map):
        self.every_map, self.found = every_map, []

    def map(self, now_ns, take):
        if self.every_map:
            take()

    def landing(self, now_ns, found):
        self.found.append((now_ns, found.stamp_ns))


def fly(moments, every_map):
    """Answers and stamps of the maps taken; a scan is mapped at every moment but each tenth."""
    config = configured(
        domain={"size": 8.0, "min_level": 1, "max_level": 3},
        publish={"rate": 10.0, "lss_rate": 4.0},
    )
    cells = mapped(config, flat(), density=10.0, scans=1).snapshot()
    answers, taken, stamp_ns = Answers(every_map), [], 0

    def snapshot():
        taken.append(stamp_ns)
        return replace(cells, stamp_ns=stamp_ns)

    assessments = Assessments(config, dict)
    assessments.on_map.append(answers.map)
    assessments.on_assessment.append(answers.landing)
    for number, now_ns in enumerate(moments, start=1):
        if number % 10:
            stamp_ns = number
            assessments.changed()
        assessments.tick(now_ns, snapshot)
    assessments.finish(moments[-1], snapshot)
    return answers.found, taken


def test_it_ends_where_no_place_is_within_reach():
    config = configured(lss={"assessment": "probability"})
    cells = mapped(config, flat(3.0)).snapshot()
    assessments = Assessments(config, lambda: {"vehicle": (20.0, 0.5, 900.0, 8.0)})
    assessments.on_assessment.append(
        lambda *_: None if assessments.last.number < 50 else pytest.fail("no end")
    )
    assessments.land_now()
    assessments.finish(START, lambda: cells)
    assert not assessments.last.selected.id and assessments.last.safe.any()


@pytest.mark.parametrize("back", [0, 30 * MS, 120 * MS, 200 * MS, 5000 * MS])
@pytest.mark.parametrize("step", [10 * MS, 50 * MS, 70 * MS, 400 * MS])
def test_maps_that_no_answer_needs_are_not_taken(step, back):
    """Taken or not, the answers are of the same maps, even where a clock goes back."""
    moments = [START + step * k - (back if k > 25 else 0) for k in range(60)]
    answers, taken = fly(moments, every_map=False)
    same, all_maps = fly(moments, every_map=True)
    assert answers == same and len(answers) > 2
    times = [now_ns for now_ns, _ in answers[:-1]]  # the last is made at the end
    gaps = [b - a for a, b in zip(times, times[1:], strict=False) if b > a]
    assert min(gaps) >= 250 * MS and (back < 250 * MS or moments[26] in times)
    assert {stamp for _, stamp in answers} <= set(taken) <= set(all_maps)
    assert step >= 250 * MS or len(taken) < 0.7 * len(all_maps)
