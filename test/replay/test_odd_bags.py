# SPDX-License-Identifier: Apache-2.0
"""Damaged and odd bags: each is replayed as far as it goes, or one line says what is wrong."""

import shutil

import numpy as np
import pytest
import replay.recordings
import yaml
from replay.recordings import (
    CLOUD,
    GROUND,
    POSE,
    SECOND,
    flight,
    recording,
    storage_file,
    write_ros2,
)

from quadtree_lss.cli import main
from quadtree_lss.desk.bags.bag import Bag
from quadtree_lss.desk.replay.replay import replay as run_replay
from quadtree_lss.onboard.config.settings import config_from_values

VALUES = {**GROUND, "domain.max_level": 5}
CONFIG = config_from_values(VALUES)


def scans_mapped(path, tmp_path):
    result = run_replay(path, tmp_path / "out", CONFIG, report=False)
    return result.summary["scans"], result.losses


def refused(path, tmp_path, capsys):
    """The one line with which a replay refuses a bag."""
    settings = [f"--set={key}={value}" for key, value in VALUES.items()]
    code = main(["replay", str(path), "--out", str(tmp_path / "out"), "--no-report", *settings])
    out, err = capsys.readouterr()
    assert code == 1 and out == "" and err.count("\n") == 1
    assert not (tmp_path / "out").exists()
    return err


def write_split(split, whole, plugin, choose):
    """The messages of a bag in two files of one folder: ``choose(k, message)`` tells which."""
    kinds = {"/lidar/points": CLOUD, "/nav/pose": POSE}
    with Bag(whole) as bag:
        messages = list(bag.messages(list(kinds)))
    split.mkdir()
    names = []
    for part in (0, 1):
        path = split.with_name(f"part{part}")
        with recording(path, plugin=plugin) as recorder:
            connections = {}
            for message in (m for k, m in enumerate(messages) if choose(k, m) == part):
                topic, raw = message.topic, bytes(message.raw)
                if topic not in connections:
                    kind = kinds[topic]
                    connections[topic] = recorder.writer.add_connection(
                        topic, kind, typestore=recorder.store
                    )
                recorder.writer.write(connections[topic], message.received_ns, raw)
        file = storage_file(path)
        names.append(f"split_{part}{file.suffix}")
        shutil.copy(file, split / names[-1])
    metadata = yaml.safe_load((path / "metadata.yaml").read_text())
    metadata["rosbag2_bagfile_information"]["relative_file_paths"] = names
    return metadata


@pytest.mark.parametrize("plugin", ["mcap", "sqlite3"])
@pytest.mark.parametrize("listed", [True, False])
@pytest.mark.parametrize(
    "choose",
    [lambda k, message: int(k > 30), lambda k, message: int(message.topic == "/nav/pose")],
    ids=["by time", "by topic"],
)
def test_a_bag_split_into_several_files(tmp_path, plugin, listed, choose):
    whole = write_ros2(tmp_path / "flight", plugin=plugin, scans=30)
    metadata = write_split(tmp_path / "split", whole, plugin, choose)
    if listed:
        (tmp_path / "split" / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    result = run_replay(tmp_path / "split", tmp_path / "out", CONFIG, report=False)
    assert result.summary["scans"] == 30
    assert [line.split()[0] for line in result.losses] == ["metadata.yaml"] * (not listed)
    expected = run_replay(whole, tmp_path / "expected", CONFIG, report=False)
    np.testing.assert_array_equal(result.cells.z, expected.cells.z)


@pytest.mark.parametrize("start", [0, 3 * SECOND])
def test_stamps_of_1970(tmp_path, monkeypatch, start):
    monkeypatch.setattr(replay.recordings, "START", start)
    assert scans_mapped(write_ros2(tmp_path / "bag"), tmp_path) == (10, ())


def test_a_bag_received_long_after_its_stamps(tmp_path, monkeypatch):
    """Old data recorded again: stamps and times of reception have nothing to do with each other."""
    path = tmp_path / "bag"
    with recording(path) as recorder:
        plain = recorder.write
        recorder.write = lambda topic, msg, kind, at: plain(topic, msg, kind, at + 10**17)
        flight(recorder)
    assert scans_mapped(path, tmp_path) == (10, ())


def test_a_map_without_its_other_half(tmp_path, capsys):
    bag = write_ros2(tmp_path / "flight")
    run_replay(bag, None, CONFIG, record=tmp_path / "products")
    half = tmp_path / "half"
    with Bag(tmp_path / "products") as products:
        cells = list(products.messages(["/map/cells"]))
        with recording(half) as recorder:
            store = recorder.store
            connection = recorder.writer.add_connection("/map/cells", CLOUD, typestore=store)
            for message in cells:
                recorder.writer.write(connection, message.received_ns, bytes(message.raw))
    assert "no messages of type" in refused(half, tmp_path, capsys)
