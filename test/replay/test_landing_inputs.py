# SPDX-License-Identifier: Apache-2.0
"""Areas, keep-outs and targets offline: of the bag and of the command line."""

from __future__ import annotations

import functools
import json

import numpy as np
import pytest
from replay.recordings import GROUND, KEEP_OUT, SECOND, START, LandingRecorder, flight
from rosbags.rosbag2 import StoragePlugin, Writer

from quadtree_lss.cli import main
from quadtree_lss.desk.bags.bag import Bag, BagError
from quadtree_lss.desk.bags.message_types import typestore
from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.onboard.config.settings import config_from_values

CONFIG = config_from_values({**GROUND, "domain.max_level": 5})
WEST = [(-15.0, -15.0), (0.0, -15.0), (0.0, 15.0), (-15.0, 15.0)]


def write(path, say=lambda recorder: None):
    """A flight in which ``say`` asks something of landing first."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        recorder = LandingRecorder(writer)
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
    found = []
    for x in (-8.0, 8.0):
        say = functools.partial(LandingRecorder.target, topic="/landing/target", x=x, y=1.0)
        bag = write(tmp_path / f"target{x}", functools.partial(say, received_ns=START))
        found.append(sites(bag).sites.position[0, :2])
    (west, _), (east_most, _) = found
    assert west <= 0.0 < east_most and east_most - west > 5.0


def test_the_last_word_counts_and_options_outrank_it(tmp_path):
    def say(recorder):
        recorder.polygon("/landing/keep_out", KEEP_OUT, START)
        recorder.polygon("/landing/keep_out", [], START + SECOND // 2)

    bag = write(tmp_path / "bag", say)
    assert east(sites(bag)) > 0.0
    assert east(sites(bag, duration=0.4)) == 0.0
    assert east(sites(bag, duration=0.4, landing={"keep_out": None})) > 0.0
    assert east(sites(bag, landing={"keep_out": KEEP_OUT})) == 0.0


def test_a_keep_out_that_cannot_be_used_withholds_all_sites(tmp_path):
    bag = write(tmp_path / "bag", lambda r: r.polygon("/landing/keep_out", KEEP_OUT, START, "odom"))
    result = replay(bag, None, CONFIG, report=False)
    assert not len(result.assessment.sites.score)
    assert "landing/keep_out cannot be used" in result.summary["explanation"]
    assert any("keep_out_frame" in line and "'odom'" in line for line in result.warnings)
    assert len(sites(bag, landing={"keep_out": None}).sites.score)


def test_several_topics_of_one_name_are_ambiguous(tmp_path):
    def say(recorder):
        recorder.polygon("/a/landing/area", WEST, START)
        recorder.polygon("/b/landing/area", WEST, START)

    bag = write(tmp_path / "bag", say)
    with pytest.raises(BagError, match="/a/landing/area, /b/landing/area.*--area"):
        sites(bag)
    assert east(sites(bag, landing={"area": WEST})) == 0.0


def run(bag, out, *options):
    settings = [f"--set={key}={value}" for key, value in GROUND.items()]
    options = [*settings, "--no-report", "-q", *options]
    return main(["replay", str(bag), "--out", str(out), *options])


def test_the_command_line_says_where_to_land(tmp_path, free):
    corners = " ".join(f"{x:g},{y:g}" for x, y in KEEP_OUT)
    assert run(free, tmp_path, f"--keep-out={corners}", "--target=-8,1", "--area=none") == 0
    told = json.loads((tmp_path / "summary.json").read_text())["landing"]
    assert told == {"keep_out": [list(c) for c in KEEP_OUT], "target": [-8.0, 1.0]}
    rows = np.loadtxt(tmp_path / "sites.csv", delimiter=",", skiprows=1, ndmin=2)
    assert len(rows) and (rows[:, 1] < 0.0).all()


@pytest.mark.parametrize(
    "option",
    ["--area=1,2 3,4", "--keep-out=1,2 3,4 5", "--target=1", "--target=1,nan", "--area="],
)
def test_wrong_places_are_wrong_usage(tmp_path, free, option, capsys):
    assert run(free, tmp_path / "out", option) == 2
    assert option.partition("=")[0] in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_products_are_recorded_as_asked(tmp_path, free):
    replay(free, None, CONFIG, report=False, record=tmp_path / "products", landing={"area": WEST})
    found = sites(tmp_path / "products")
    assert len(found.sites.score) and east(found) > 0.0
    with_area = replay(free, None, CONFIG, report=False, landing={"area": WEST})
    with Bag(tmp_path / "products") as products:
        raw = [m.raw for m in products.messages(["/landing/sites"])]
    poses = typestore(ros1=False).deserialize_cdr(raw[-1], "geometry_msgs/msg/PoseArray").poses
    np.testing.assert_array_equal(
        [pose.position.x for pose in poses], with_area.assessment.sites.position[:, 0]
    )
