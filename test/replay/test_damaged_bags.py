# SPDX-License-Identifier: Apache-2.0
"""Damage costs what it hits and is told; what could take gigabytes or for ever is not begun."""

import bz2
import sqlite3
import struct
import tracemalloc
import zlib
from contextlib import closing

import lz4.frame
import numpy as np
import pytest
import zstandard
from replay.recordings import CLOUD, GROUND, SECOND, flight, recording, storage_file, write_ros2

from quadtree_lss.cli import main
from quadtree_lss.desk.bags.bag import Bag, BagError
from quadtree_lss.desk.bags.compression import MOST_BYTES, DamagedError, unpack
from quadtree_lss.desk.bags.mcap_file import McapFile
from quadtree_lss.desk.replay.info import inspect_bag
from quadtree_lss.desk.replay.passes import _Clock
from quadtree_lss.desk.replay.replay import replay as run_replay
from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.messages.clouds import MessageError

TOPICS = ("/lidar/points", "/nav/pose")
VALUES = {**GROUND, "domain.max_level": 5}
CONFIG = config_from_values(VALUES)
SCANS = 24
STORAGES = {
    "mcap": {},
    "mcap, file": {"compression": "file"},
    "mcap, message": {"compression": "message"},
    "mcap, chunks": {},
    "sqlite3": {"plugin": "sqlite3"},
    "sqlite3, file": {"plugin": "sqlite3", "compression": "file"},
    "ros1": {},
    "ros1, bz2": {"compression": "BZ2"},
    "ros1, lz4": {"compression": "LZ4"},
}


def chunked(path, **more):
    """An mcap bag as a vehicle's recorder writes it: chunks compressed, with checksums."""
    write_ros2(path, compression="storage", **more)
    file = storage_file(path)
    content = bytearray(file.read_bytes())
    with closing(McapFile(file)) as opened:
        for chunk in opened.chunks:
            records = zstandard.decompress(content[chunk.begin : chunk.end])
            struct.pack_into("<I", content, chunk.place + 33, zlib.crc32(records))
    file.write_bytes(content)
    return path


def shifted(recorder, shift):
    """Message k is received ``shift(k)`` ns later."""
    plain, number = recorder.write, iter(range(10**6))
    recorder.write = lambda topic, msg, kind, at: plain(topic, msg, kind, at + shift(next(number)))
    return recorder


def file_of(path):
    return path if path.is_file() else storage_file(path)


def read(path):
    """Stamp-free content of all messages, and the losses."""
    with Bag(path) as bag:
        found = [(m.topic, bytes(m.raw)) for m in bag.messages(TOPICS)]
        return found, bag.losses


def chunks_of(path):
    """Begin and end of each chunk's record with the index behind it, in the file."""
    file = file_of(path)
    with closing(McapFile(file)) as opened:
        places = [chunk.place for chunk in opened.chunks]
    content = file.read_bytes()
    return places, content


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    path = chunked(tmp_path_factory.mktemp("sound") / "bag", scans=SCANS, across=150)
    found, losses = read(path)
    assert len(found) == 3 * SCANS + 2 and not losses and len(chunks_of(path)[0]) > 5
    return path, found


def spoilt(sound, tmp_path, content):
    path = tmp_path / "spoilt.mcap"
    path.write_bytes(content)
    found, losses = read(path)
    assert set(found) <= set(sound[1])
    return found, losses


def test_one_flipped_bit_costs_one_chunk_and_is_told(sound, tmp_path, capsys):
    places, content = chunks_of(sound[0])
    damaged = bytearray(content)
    damaged[(places[2] + places[3]) // 2] ^= 4
    found, losses = spoilt(sound, tmp_path, bytes(damaged))
    (line,) = losses
    lost = len(sound[1]) - len(found)
    assert 0 < lost < len(sound[1]) // 3
    assert f" at byte {places[2]}, {lost} of {len(sound[1])} messages lost" in line
    settings = [f"--set={key}={value}" for key, value in VALUES.items()]
    arguments = ["replay", tmp_path / "spoilt.mcap", "--out", tmp_path / "out", "--no-report"]
    assert main([*map(str, arguments), *settings]) == 3
    err = capsys.readouterr().err
    assert (
        err.count("quadtree-lss: damaged: ") == 1
        and f"{lost} of {len(sound[1])} messages lost" in err
    )


@pytest.mark.parametrize("summary", [True, False])
def test_a_chunk_that_is_cut_out_is_missed(sound, tmp_path, summary):
    places, content = chunks_of(sound[0])
    end = None if summary else content.rindex(b"\x0f" + (4).to_bytes(8, "little"))
    less = content[: places[2] + 5] + content[places[3] + 7 : end]
    found, losses = spoilt(sound, tmp_path, less)
    (line,) = losses
    lost = len(sound[1]) - len(found)
    assert 0 < lost < len(sound[1]) // 2 and "damaged or cut out" in line
    assert ("is not known" if not summary else f"{lost} of {len(sound[1])} messages lost") in line


def test_chunks_out_of_order_are_put_in_order_and_told(sound, tmp_path):
    places, content = chunks_of(sound[0])
    a, b, c = places[2], places[3], places[4]
    found, losses = spoilt(sound, tmp_path, content[:a] + content[b:c] + content[a:b] + content[c:])
    assert found == sound[1]
    assert losses == ["spoilt.mcap: chunks out of order, put in that of their times"]


def test_a_message_that_says_another_channel_than_the_index_is_lost(tmp_path):
    """Chunks without compression or checksum: only the index tells."""
    file = storage_file(write_ros2(tmp_path / "bag"))
    whole, _ = read(file)
    with closing(McapFile(file)) as opened:
        entry, chunk = opened.index[5], opened.chunks[0]
    content = bytearray(file.read_bytes())
    place = chunk.begin + int(entry["offset"]) + 9
    assert content[place] == entry["channel"] in (0, 1)
    content[place] ^= 1
    file.write_bytes(content)
    found, (line,) = read(file)
    assert len(found) == len(whole) - 1 and f"1 of {len(whole)} messages lost" in line


@pytest.mark.parametrize("back", [2 * SECOND, 4000 * SECOND])
@pytest.mark.parametrize("storage", ["mcap", "sqlite3", "ros1", "mcap in one chunk"])
def test_a_recorder_clock_that_steps_back_costs_no_scan(tmp_path, storage, back):
    def shift(k):
        return -back if k > 40 else 0

    path = tmp_path / ("flight.bag" if storage == "ros1" else "flight")
    with recording(path, plugin="sqlite3" if storage == "sqlite3" else "mcap") as recorder:
        across = 24 if "one" in storage else 150
        flight(shifted(recorder, shift), scans=SCANS, across=across)
    result = run_replay(path, None, CONFIG)
    assert result.summary["scans"] == SCANS and not result.losses
    assert any("clock stepped back" in line for line in result.warnings)
    assert not any("jumped" in line for line in result.warnings)


def test_passes_go_on_after_a_step_back_of_the_clock():
    clock = _Clock(4.0)
    clock.changed = True
    assert clock.due(100 * SECOND)
    clock.sent(100 * SECOND)
    assert not clock.due(100 * SECOND)
    clock.changed = True
    assert not clock.due(100 * SECOND + SECOND // 5) and clock.due(101 * SECOND)
    assert clock.due(20 * SECOND)


def damaged_rows(path, statement, *values):
    database = sqlite3.connect(file_of(path))
    database.execute("PRAGMA ignore_check_constraints = ON")
    database.execute(statement, values)
    database.commit()
    database.close()


@pytest.mark.parametrize("row", [1, 30, 3 * SCANS + 2])
@pytest.mark.parametrize("when", ["soon", b"\x00", 0, -5, 2**63 - 1, 1.5e300])
def test_one_row_with_a_bad_time_costs_nothing(tmp_path, row, when):
    path = write_ros2(tmp_path / "bag", plugin="sqlite3", scans=SCANS)
    whole, _ = read(path)
    damaged_rows(path, "UPDATE messages SET timestamp = ? WHERE id = ?", when, row)
    with Bag(path) as bag:
        assert bag.end_ns - bag.start_ns < 3 * SECOND
        assert sorted((m.topic, bytes(m.raw)) for m in bag.messages(TOPICS)) == sorted(whole)
        (line,) = bag.losses
    assert "impossible time" in line


@pytest.mark.parametrize("data", [None, "text", 7])
def test_a_row_without_data_costs_one_message(tmp_path, data):
    path = write_ros2(tmp_path / "bag", plugin="sqlite3", scans=SCANS)
    whole, _ = read(path)
    damaged_rows(path, "CREATE TABLE other AS SELECT * FROM messages")
    damaged_rows(path, "DROP TABLE messages")
    damaged_rows(path, "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
    damaged_rows(path, "INSERT INTO messages SELECT * FROM other")
    damaged_rows(path, "UPDATE messages SET data = ? WHERE id = 9", data)
    found, losses = read(path)
    assert len(found) == len(whole) - 1
    assert len(losses) == 1 and "at row 9, at least 1 messages lost" in losses[0]


ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT"
ROW = "i id, 1 topic_id, 1 timestamp, x'' data"
VIEWS = [
    ("messages", f"CREATE VIEW messages AS {ENDLESS} {ROW} FROM n"),
    ("messages", f"CREATE VIEW messages AS {ENDLESS} count(*) id FROM n"),
    ("topics", f"CREATE VIEW topics AS {ENDLESS} i id, 'x' name, 'y' type FROM n"),
    (
        "messages",
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp,"
        " data AS (zeroblob(1000000000)))",
    ),
]


@pytest.mark.parametrize(("table", "statement"), VIEWS)
def test_what_an_sqlite_file_would_compute_is_not_begun(tmp_path, table, statement):
    path = write_ros2(tmp_path / "bag", plugin="sqlite3")
    damaged_rows(path, f"DROP TABLE {table}")
    damaged_rows(path, statement)
    with pytest.raises(BagError, match="not a plain table") as caught, Bag(path):
        pass
    assert "\n" not in str(caught.value)


def test_small_messages_that_mean_gigabytes_are_refused(tmp_path):
    bomb = zstandard.compress(bytes(1 << 30))
    assert len(bomb) < 1e5
    with Bag(write_ros2(tmp_path / "bag")) as bag:
        with pytest.raises(MessageError, match="holds more than the"):
            bag.decode(bomb, CLOUD)


@pytest.mark.parametrize("claimed", [1000, MOST_BYTES + 1, 1 << 40])
@pytest.mark.parametrize("pack", ["zstd", "lz4", "bz2"])
def test_chunks_are_unpacked_to_what_they_claim_and_no_further(pack, claimed):
    packers = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "bz2": bz2.compress}
    bomb = packers[pack](bytes(1 << 26))
    assert unpack(pack, bomb, 1 << 26) == bytes(1 << 26)
    tracemalloc.start()
    with pytest.raises(DamagedError, match="claim"):
        unpack(pack, bomb, claimed)
    assert tracemalloc.get_traced_memory()[1] < 1e7
    tracemalloc.stop()


def test_a_file_that_unpacks_to_gigabytes_is_read_so_far_and_told(tmp_path, monkeypatch):
    monkeypatch.setattr("quadtree_lss.desk.bags.compression.FREE_BYTES", 1 << 22)
    plain = storage_file(write_ros2(tmp_path / "bag")).read_bytes()
    (tmp_path / "bomb.mcap.zstd").write_bytes(zstandard.compress(plain + bytes(1 << 28)))
    with Bag(tmp_path / "bomb.mcap.zstd") as bag:
        assert len(list(bag.messages(TOPICS))) == 32
        assert any("times its size" in loss for loss in bag.losses)


def test_messages_that_cannot_be_decoded_are_losses(tmp_path):
    path = write_ros2(tmp_path / "bag", plugin="sqlite3")
    damaged_rows(path, "UPDATE messages SET data = substr(data, 1, 90) WHERE id IN (3, 9)")
    result = run_replay(path, None, CONFIG)
    (line,) = result.losses
    assert "2 messages of /" in line and "cannot be decoded" in line
    assert inspect_bag(path, CONFIG).losses == [line]


def test_a_keep_out_that_cannot_be_decoded_is_a_loss(tmp_path):
    with recording(tmp_path / "bag") as recorder:
        flight(recorder)
        kind = "geometry_msgs/msg/PolygonStamped"
        raw = b"\x00\x01\x00\x00none"
        recorder.write_raw("/landing/keep_out", raw, kind, 1_700_000_000 * SECOND)
    result = run_replay(tmp_path / "bag", None, CONFIG)
    (line,) = result.losses
    assert "1 messages lost: landing/keep_out" in line and not len(result.assessment.sites.score)


def test_numbers_that_mean_the_same_agree(tmp_path):
    """Of messages recorded, taken and refused, by replay and by info."""
    path = tmp_path / "bag"
    with recording(path) as recorder:
        flight(recorder, scans=SCANS)
        pose = recorder.pose(10**9, (0, 0, 9.0))
        last = 10**9 * 1_700_000_100
        for k, frame in enumerate(["map", "odom", "map", "map"]):
            pose = recorder.pose(last if k > 1 else last + k, (0.0, 0.0, 50.0), frame=frame)
            recorder.write("/nav/pose", pose, "geometry_msgs/msg/PoseWithCovarianceStamped", last)
        for _ in range(2):  # of no pose, and the same once more
            cloud = recorder.cloud(last + 5, np.ones((2, 2, 3)))
            recorder.write("/lidar/points", cloud, CLOUD, last)
        recorder.write("/lidar/points", recorder.cloud(last, np.ones((0, 2, 3))), CLOUD, last)
    result, info = run_replay(path, None, CONFIG), inspect_bag(path, CONFIG)
    summary, topics = result.summary, {topic.name: topic for topic in info.topics}
    refused = summary["messages_rejected"]
    poses = sum(n for key, n in refused.items() if key.startswith("pose_"))
    assert summary["poses"] + poses == topics["/nav/pose"].count
    assert summary["scans"] + sum(summary["scans_dropped"].values()) == SCANS + 3
    assert topics["/lidar/points"].count == SCANS + 3
    assert info.scans_with_pose == summary["scans"]
    assert info.scans_dropped == summary["scans_dropped"]
    assert (info.points, info.points_dropped) == (summary["points"], summary["points_dropped"])
    assert summary["points"] == summary["points_used"] + sum(summary["points_dropped"].values())


@pytest.mark.parametrize("name", ["/a\n\x1b[2Jdamaged: none", "/" + "q" * 10**6, "/\u202eevil"])
def test_names_in_a_bag_are_shown_in_one_short_line(tmp_path, capsys, name):
    names = dict(scan_topics=(name, "/other"))
    path = write_ros2(tmp_path / "bag", plugin="sqlite3", **names)
    assert main(["info", str(path)]) == 1
    assert main(["replay", str(path), "--out", str(tmp_path / "out")]) == 1
    shown = capsys.readouterr()
    for line in (shown.out + shown.err).split("\n"):
        assert line.isprintable() and len(line) < 1200
    assert shown.err.count("\n") == 1


def try_damage(storage, folder, seed, number):
    """Flipped bits, zeros, cuts and inserted bytes: no exception but one line, and no hanging."""
    rng = np.random.default_rng(seed)
    make = chunked if "chunks" in storage else write_ros2
    name = "flight.bag" if "ros1" in storage else "bag"
    path = make(folder / name, scans=16, **STORAGES[storage])
    whole, losses = read(path)
    assert len(whole) == 50 and not losses
    file = file_of(path)
    content = file.read_bytes()
    told = 0
    for _ in range(number):
        place = int(rng.integers(len(content)))
        end = place + int(2 ** rng.uniform(0, 12))
        middle = content[place:end]
        kind = rng.integers(4)
        if kind == 0:
            middle = bytes([middle[0] ^ 1 << int(rng.integers(8))]) + middle[1:]
        elif kind == 1:
            middle = bytes(len(middle))
        elif kind == 2:
            middle = b""
        else:
            middle *= 2
        file.write_bytes(content[:place] + middle + content[end:])
        try:
            found, losses = read(path)
        except BagError as error:
            assert str(error).isprintable()
            losses, found = [str(error)], []
        assert all(line.isprintable() for line in losses)
        assert losses or len(found) >= len(whole), f"messages lost in silence at {place}, {kind}"
        told += bool(losses)
    assert told


@pytest.mark.parametrize("storage", STORAGES)
def test_damaged_bags_of_every_storage(storage, tmp_path):
    try_damage(storage, tmp_path, 1, 25)


@pytest.mark.slow
@pytest.mark.parametrize("storage", STORAGES)
def test_many_more_of_them(storage, tmp_path):
    try_damage(storage, tmp_path, 2, 150)
