# SPDX-License-Identifier: Apache-2.0
"""Areas, keep-outs and targets offline: of the bag and of the command line."""

import functools
import json

import numpy as np
import pytest
from replay.recordings import GROUND, KEEP_OUT, SECOND, START, LandingRecorder, flight, recording

from quadtree_lss.cli import main
from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.lab.simulation.recording import Messages
from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.messages.landing_inputs import Navigation

CONFIG = config_from_values({**GROUND, "domain.max_level": 5})
WEST = [(-15.0, -15.0), (0.0, -15.0), (0.0, 15.0), (-15.0, 15.0)]


def write(path, say=lambda recorder: None):
    """A flight in which ``say`` asks something of landing first."""
    with recording(path, LandingRecorder) as recorder:
        say(recorder)
        flight(recorder)
    return path


def sites(bag, **options):
    return replay(bag, None, CONFIG, report=False, **options).assessment


def east(found):
    return (found.sites.position[:, 0] > 0.0).mean()


@pytest.fixture(scope="module")
def free(tmp_path_factory):
    return write(tmp_path_factory.mktemp("bags") / "free")


def test_a_keep_out_an_area_and_a_target_of_the_bag_hold(tmp_path, free):
    assert east(sites(free)) > 0.0
    for name, say in (
        ("keep_out", lambda recorder: recorder.polygon("/landing/keep_out", KEEP_OUT, START)),
        ("area", lambda recorder: recorder.polygon("/lander/landing/area", WEST, START)),
    ):
        bag = write(tmp_path / name, say)
        for start in (0.0, 0.3):  # latched: what was said before holds
            assert not len(sites(bag, start=start).sites) or east(sites(bag, start=start)) == 0.0
    first = sites(free).sites.position[0, :2]
    for x in (-8.0, 8.0):
        say = functools.partial(LandingRecorder.target, topic="/landing/target", x=x, y=1.0)
        bag = write(tmp_path / f"target{x}", functools.partial(say, received_ns=START))
        wanted, found = np.array([x, 1.0]), sites(bag).sites.position[0, :2]
        assert np.linalg.norm(found - wanted) < np.linalg.norm(first - wanted) - 0.2


def test_the_last_word_counts_and_options_outrank_it(tmp_path):
    def say(recorder):
        recorder.polygon("/landing/keep_out", KEEP_OUT, START)
        recorder.polygon("/landing/keep_out", [], START + SECOND // 2)

    bag = write(tmp_path / "bag", say)
    assert east(sites(bag)) > 0.0
    assert east(sites(bag, duration=0.4)) == 0.0
    assert east(sites(bag, duration=0.4, landing={"keep_out": None})) > 0.0
    assert east(sites(bag, landing={"keep_out": KEEP_OUT})) == 0.0


def test_keep_outs_hold_together_each_until_its_id_is_sent_again(tmp_path):
    """The ground is 32 m wide: the east and the west leave nothing."""
    small = [(1.0, 1.0), (2.0, 1.0), (2.0, 2.0)]

    def say(recorder):
        recorder.keep_out(7, KEEP_OUT, START)
        recorder.keep_out(-8, WEST, START)
        recorder.polygon("/landing/keep_out", small, START)
        recorder.keep_out(-8, small, START + 5 * SECOND // 10)
        recorder.keep_out(7, [], START + 8 * SECOND // 10)

    bag = write(tmp_path / "bag", say)
    assert not len(sites(bag, duration=0.4).sites)
    west = sites(bag, duration=0.7)
    assert len(west.sites) and east(west) == 0.0
    result = replay(bag, None, CONFIG, report=False)
    assert east(result.assessment) > 0.0
    held = result.summary["landing"]
    assert held == dict.fromkeys(("keep_out", "keep_outs/-8"), [list(c) for c in small])
    assert len(sites(bag, duration=0.4, landing={"keep_outs": None}).sites)
    assert not len(sites(bag, landing={"keep_outs": [KEEP_OUT, WEST]}).sites)


def test_height_and_speed_are_those_of_the_poses():
    navigation, make = Navigation(), Messages()
    poses = [(0.1 * k, 100.0 - 0.7 * k) for k in range(31)] + [(3.1, np.nan), (60.0, 20.0)]
    told = []
    for time, z in poses:
        level = np.array([0.0, 0.0, 0.0, 1.0])
        x = 1.0 + 3.0 * time * (time < 50.0)
        pose = make.pose(START + round(time * SECOND), np.array([x, 2.0, z]), level, np.eye(6))
        navigation.use_pose(pose)
        told.append(navigation.vehicle("map"))
    assert told[0] == (100.0, 0.0, 1.0, 2.0, 0.0, 0.0) and told[31] == told[30]
    assert told[30] == pytest.approx((79.0, 7.0, 10.0, 2.0, 3.0, 0.0))
    assert told[-1] == (20.0, 0.0, 1.0, 2.0, 0.0, 0.0), "a time jump"
    assert navigation.vehicle("moon") is None


def run(bag, out, *options):
    settings = [f"--set={key}={value}" for key, value in GROUND.items()]
    options = [*settings, "--no-report", "-q", *options]
    return main(["replay", str(bag), "--out", str(out), *options])


def test_the_command_line_says_where_to_land(tmp_path, free):
    corners = " ".join(f"{x:g},{y:g}" for x, y in KEEP_OUT)
    assert run(free, tmp_path, f"--keep-out={corners}", "--target=-8,1", "--area=none") == 0
    told = json.loads((tmp_path / "summary.json").read_text())["landing"]
    assert told == {"keep_out": [list(c) for c in KEEP_OUT], "target": [-8.0, 1.0]}
    assert run(free, tmp_path, f"--keep-out={corners}", "--keep-out=-1,-1 -2,-1 -2,-2") == 0
    told = json.loads((tmp_path / "summary.json").read_text())["landing"]
    assert list(told) == ["keep_out", "keep_outs/1"] and told["keep_outs/1"][2] == [-2.0, -2.0]
    rows = np.loadtxt(tmp_path / "sites.csv", delimiter=",", skiprows=1, ndmin=2)
    assert len(rows) and (rows[:, 1] < 0.0).all()


@pytest.mark.parametrize(
    "option", ["--area=1,2 3,4", "--keep-out=1,2 3,4 5", "--target=1", "--target=1,nan", "--area="]
)
def test_wrong_places_are_wrong_usage(tmp_path, free, option, capsys):
    assert run(free, tmp_path / "out", option) == 2
    assert option.partition("=")[0] in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
