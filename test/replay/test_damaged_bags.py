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
from replay.recordings import CLOUD, GROUND, POSE, SECOND, flight, recording, storage_file
from replay.recordings import write_ros2 as write

from quadtree_lss.cli import main
from quadtree_lss.desk.bags.bag import Bag, BagError
from quadtree_lss.desk.bags.compression import MOST_BYTES, DamagedError, unpack
from quadtree_lss.desk.bags.mcap_file import McapFile
from quadtree_lss.desk.bags.ros1_file import Ros1File
from quadtree_lss.desk.replay.info import inspect_bag
from quadtree_lss.desk.replay.replay import replay as run_replay
from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.messages.clouds import MessageError

TOPICS = ("/lidar/points", "/nav/pose")
CONFIG = config_from_values({**GROUND, "domain.max_level": 5})
SCANS = 24
WHOLE = 3 * SCANS + 2
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
    file = file_of(write(path, compression="storage", **more))
    content = bytearray(file.read_bytes())
    with closing(McapFile(file)) as opened:
        for chunk in opened.chunks:
            records = zstandard.decompress(content[chunk.begin : chunk.end])
            struct.pack_into("<I", content, chunk.place + 33, zlib.crc32(records))
    file.write_bytes(content)
    return path


def file_of(path):
    return path if path.is_file() else storage_file(path)


def read(path):
    """Topic and bytes of all messages, and the losses."""
    with Bag(path) as bag:
        found = [(m.topic, bytes(m.raw)) for m in bag.messages(TOPICS)]
        return found, bag.losses


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """The file, its messages, and where its chunks begin and end."""
    file = file_of(chunked(tmp_path_factory.mktemp("sound") / "bag", scans=SCANS, across=150))
    found, losses = read(file)
    with closing(McapFile(file)) as opened:
        places, ends = zip(*((chunk.place, chunk.end) for chunk in opened.chunks), strict=True)
    assert len(found) == WHOLE and not losses and len(places) > 5
    return file.read_bytes(), found, places, ends


END = b"\x0f" + (4).to_bytes(8, "little")
"""The record that ends the data, before the summary."""


WHERE = ["flipped", "cut out", "cut out, no summary", "out of order", "index", "length"]


@pytest.mark.parametrize("what", WHERE)
def test_damaged_chunks_cost_themselves_and_are_told_in_one_line(sound, tmp_path, what):
    content, whole, places, ends = sound
    a, b, c = places[2:5]
    middle = (a + b) // 2
    # Of the chunk's second channel; that of the first stays.
    index = ends[2] + 9 + int.from_bytes(content[ends[2] + 1 : ends[2] + 9], "little")
    end = content.rindex(END) if "summary" in what else None
    damaged, told = {
        "flipped": (
            content[:middle] + bytes([content[middle] ^ 4]) + content[middle + 1 :],
            f" at byte {a}, ",
        ),
        "cut out": (content[: a + 5] + content[b + 7 :], "damaged or cut out"),
        "cut out, no summary": (content[: a + 5] + content[b + 7 : end], "is not known"),
        "out of order": (
            content[:a] + content[b:c] + content[a:b] + content[c:],
            "chunks out of order, put in that of their times",
        ),
        # Of a record that then leads into the next chunk but one.
        "length": (content[: ends[2] + 3] + b"\x20" + content[ends[2] + 4 :], f"0 of {WHOLE}"),
        "index": (content[: index + 5] + content[index + 9 :], f"at byte {index}, 0 of {WHOLE}"),
    }[what]
    path = tmp_path / "spoilt.mcap"
    path.write_bytes(damaged)
    found, (line,) = read(path)
    kept = [message for message in whole if message in found]
    assert told in line and found == kept
    lost = WHOLE - len(found)
    assert 0 <= lost < WHOLE // 2 and (lost == 0) == (what in WHERE[3:])
    assert end or not lost or f"{lost} of {WHOLE} messages lost" in line


def test_a_damaged_bag_is_exit_code_3(sound, tmp_path, capsys):
    content, _, places, _ = sound
    (tmp_path / "cut.mcap").write_bytes(content[: places[3] + 100])
    settings = [f"--set={key}={value}" for key, value in GROUND.items()]
    arguments = ["replay", tmp_path / "cut.mcap", "--out", tmp_path / "out", "--no-report"]
    assert main([*map(str, arguments), *settings]) == 3
    assert capsys.readouterr().err.count("quadtree-lss: damaged: cut.mcap: ends before") == 1


def test_a_message_that_says_another_channel_than_the_index_is_lost(tmp_path):
    """Chunks without compression or checksum: only the index tells."""
    file = storage_file(write(tmp_path / "bag"))
    whole, _ = read(file)
    with closing(McapFile(file)) as opened:
        entry, chunk = opened.index[5], opened.chunks[0]
    content = bytearray(file.read_bytes())
    place = chunk.begin + int(entry["offset"]) + 9
    assert content[place] == entry["channel"] in (0, 1)
    content[place] ^= 1
    file.write_bytes(content)
    found, (line,) = read(file)
    assert found == whole[:5] + whole[6:] and f"1 of {len(whole)} messages lost" in line


def test_messages_outside_chunks_are_read_and_taken_up_again(tmp_path):
    """As `ros2 bag record --storage-preset-profile fastwrite` leaves them."""
    file = storage_file(write(tmp_path / "bag"))
    whole, _ = read(file)
    with closing(McapFile(file)) as opened:
        (chunk,) = opened.chunks
    content = file.read_bytes()
    records = content[chunk.begin : chunk.end]
    head, tail = content[: chunk.place], content[content.rindex(END) :]
    file.write_bytes(head + records + tail)
    assert read(file) == (whole, [])
    middle = len(records) // 2
    file.write_bytes(head + records[:middle] + records[middle + 1000 :] + tail)
    found, (line,) = read(file)
    assert len({*found} & {*whole}) >= len(whole) - 4  # nothing tells what the hit one holds
    assert f"{len(whole) - len(found)} of {len(whole)} messages lost" in line


@pytest.mark.parametrize("compression", ["", "LZ4"])
def test_a_ros1_bag_is_taken_up_at_the_next_chunk(tmp_path, compression):
    path = write(tmp_path / "flight.bag", compression=compression, scans=SCANS, across=150)
    whole, _ = read(path)
    with closing(Ros1File(path)) as opened:
        place = opened.chunks[2].place
    content = path.read_bytes()
    path.write_bytes(content[:place] + bytes(40) + content[place + 40 :])
    found, (line,) = read(path)
    assert WHOLE // 2 < len(found) < WHOLE and found == [m for m in whole if m in found]
    assert f"at byte {place}, {WHOLE - len(found)} of {WHOLE} messages lost" in line


@pytest.mark.parametrize("back", [2 * SECOND, 4000 * SECOND])
@pytest.mark.parametrize("storage", ["mcap", "sqlite3", "ros1", "mcap in one chunk"])
def test_a_recorder_clock_that_steps_back_costs_no_scan(tmp_path, storage, back):
    path = tmp_path / ("flight.bag" if storage == "ros1" else "flight")
    with recording(path, plugin="sqlite3" if storage == "sqlite3" else "mcap") as recorder:
        plain, number = recorder.write_raw, iter(range(10**6))
        recorder.write_raw = lambda topic, raw, kind, at: plain(
            topic, raw, kind, at - back * (next(number) > 40)
        )
        flight(recorder, scans=SCANS, across=24 if "one" in storage else 150)
    result = run_replay(path, None, CONFIG)
    assert result.summary["scans"] == SCANS and not result.losses
    assert any("clock stepped back" in line for line in result.warnings)
    assert not any("jumped" in line for line in result.warnings)


def rows_changed(path, *statements, values=()):
    """An sqlite3 bag after some statements, with values for the last."""
    write(path, plugin="sqlite3", scans=SCANS)
    with closing(sqlite3.connect(storage_file(path))) as database:
        database.execute("PRAGMA ignore_check_constraints = ON")
        for statement in statements[:-1]:
            database.execute(statement)
        database.execute(statements[-1], values)
        database.commit()
    return path


@pytest.mark.parametrize("row", [1, 30, WHOLE])
@pytest.mark.parametrize("when", ["soon", b"\x00", 0, -5, 2**63 - 1, 1.5e300])
def test_one_row_with_a_bad_time_costs_nothing(tmp_path, row, when):
    query = "UPDATE messages SET timestamp = ? WHERE id = ?"
    with Bag(rows_changed(tmp_path / "bag", query, values=(when, row))) as bag:
        assert bag.end_ns - bag.start_ns < 3 * SECOND
        assert len({(m.topic, bytes(m.raw)) for m in bag.messages(TOPICS)}) == WHOLE
        (line,) = bag.losses
    assert "impossible time" in line


@pytest.mark.parametrize("data", [None, "text", 7])
def test_a_row_without_data_costs_one_message(tmp_path, data):
    path = rows_changed(
        tmp_path / "bag",
        "ALTER TABLE messages RENAME TO other",
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)",
        "INSERT INTO messages SELECT * FROM other",
        "UPDATE messages SET data = ? WHERE id = 9",
        values=(data,),
    )
    found, (line,) = read(path)
    assert len(found) == WHOLE - 1 and "at row 9, at least 1 messages lost" in line


ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT"
COMPUTED = [
    f"VIEW messages AS {ENDLESS} i id, 1 topic_id, 1 timestamp, x'' data FROM n",
    f"VIEW messages AS {ENDLESS} count(*) id FROM n",
    f"VIEW topics AS {ENDLESS} i id, 'x' name, 'y' type FROM n",
    "TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data AS (zeroblob(1000000000)))",
]


@pytest.mark.parametrize("statement", COMPUTED)
def test_what_an_sqlite_file_would_compute_is_not_begun(tmp_path, statement):
    drop = f"DROP TABLE {statement.split()[1].split('(')[0]}"
    path = rows_changed(tmp_path / "bag", drop, f"CREATE {statement}")
    with pytest.raises(BagError, match="not a plain table") as caught, Bag(path):
        pass
    assert "\n" not in str(caught.value)


def test_small_messages_that_mean_gigabytes_are_refused(tmp_path):
    with Bag(write(tmp_path / "bag")) as bag:
        with pytest.raises(MessageError, match="holds more than the"):
            bag.decode(zstandard.compress(bytes(1 << 30)), CLOUD)


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
    plain = storage_file(write(tmp_path / "bag")).read_bytes()
    (tmp_path / "bomb.mcap.zstd").write_bytes(zstandard.compress(plain + bytes(1 << 28)))
    found, losses = read(tmp_path / "bomb.mcap.zstd")
    assert len(found) == 32 and any("times its size" in loss for loss in losses)


def test_messages_that_cannot_be_decoded_are_losses(tmp_path):
    query = "UPDATE messages SET data = substr(data, 1, 90) WHERE id IN (3, 9)"
    path = rows_changed(tmp_path / "bag", query)
    (line,) = run_replay(path, None, CONFIG).losses
    assert "2 messages of /" in line and "cannot be decoded" in line
    assert inspect_bag(path, CONFIG).losses == [line]


def test_a_keep_out_that_cannot_be_decoded_is_a_loss(tmp_path):
    with recording(tmp_path / "bag") as recorder:
        flight(recorder)
        kind, raw = "geometry_msgs/msg/PolygonStamped", b"\x00\x01\x00\x00none"
        recorder.write_raw("/landing/keep_out", raw, kind, 1_700_000_000 * SECOND)
    result = run_replay(tmp_path / "bag", None, CONFIG)
    (line,) = result.losses
    assert "1 messages lost: landing/keep_out" in line and not len(result.assessment.sites.score)


def test_numbers_that_mean_the_same_agree(tmp_path):
    """Of messages recorded, the last too, taken and refused, by replay and by info."""
    path, last = tmp_path / "bag", 1_700_000_100 * SECOND
    with recording(path) as recorder:
        flight(recorder, scans=SCANS)
        for k, frame in enumerate(["map", "odom", "map", "map"]):
            pose = recorder.pose(last if k > 1 else last + k, (0.0, 0.0, 50.0), frame=frame)
            recorder.write("/nav/pose", pose, POSE, last)
        # Of no pose, the same once more, and one without points.
        for stamp, points in ((last + 5, 2), (last + 5, 2), (last, 0)):
            cloud = recorder.cloud(stamp, np.ones((points, 2, 3)))
            recorder.write("/lidar/points", cloud, CLOUD, last)
    summary, info = run_replay(path, None, CONFIG).summary, inspect_bag(path, CONFIG)
    counts = {topic.name: topic.count for topic in info.topics}
    refused = sum(n for key, n in summary["messages_rejected"].items() if key.startswith("pose_"))
    assert summary["poses"] + refused == counts["/nav/pose"]
    dropped = sum(summary["scans_dropped"].values())
    assert summary["scans"] + dropped == SCANS + 3 == counts["/lidar/points"]
    assert info.scans_with_pose == summary["scans"]
    assert info.scans_dropped == summary["scans_dropped"]
    assert (info.points, info.points_dropped) == (summary["points"], summary["points_dropped"])
    assert summary["points"] == summary["points_used"] + sum(summary["points_dropped"].values())


@pytest.mark.parametrize("name", ["/a\n\x1b[2Jdamaged: none", "/" + "q" * 10**6, "/\u202eevil"])
def test_names_in_a_bag_are_shown_in_one_short_line(tmp_path, capsys, name):
    path = write(tmp_path / "bag", plugin="sqlite3", scan_topics=(name, "/other"))
    assert main(["info", str(path)]) == 1
    assert main(["replay", str(path), "--out", str(tmp_path / "out")]) == 1
    shown = capsys.readouterr()
    for line in (shown.out + shown.err).split("\n"):
        assert line.isprintable() and len(line) < 1200
    assert shown.err.count("\n") == 1


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize(
    ("seed", "number"), [(1, 25), pytest.param(2, 150, marks=pytest.mark.slow)]
)
def test_damaged_bags_of_every_storage(storage, tmp_path, seed, number):
    """Flipped bits, zeros, cuts and doubled bytes: no exception but one line, and no hanging."""
    rng = np.random.default_rng(seed)
    make = chunked if "chunks" in storage else write
    path = tmp_path / ("flight.bag" if "ros1" in storage else "bag")
    make(path, scans=16, **STORAGES[storage])
    whole, losses = read(path)
    assert len(whole) == 50 and not losses
    file = file_of(path)
    content, told = file.read_bytes(), 0
    for _ in range(number):
        place = int(rng.integers(len(content)))
        end = place + int(2 ** rng.uniform(0, 12))
        middle = content[place:end]
        flipped = bytes([middle[0] ^ 1 << int(rng.integers(8))]) + middle[1:]
        kind = rng.integers(4)
        middle = (flipped, bytes(len(middle)), b"", middle * 2)[kind]
        file.write_bytes(content[:place] + middle + content[end:])
        try:
            found, losses = read(path)
        except BagError as error:
            losses, found = [str(error)], []
        assert all(line.isprintable() for line in losses)
        assert losses or len(found) >= len(whole), f"messages lost in silence at {place}, {kind}"
        told += bool(losses)
    assert told
