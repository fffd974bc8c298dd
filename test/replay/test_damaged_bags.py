# SPDX-License-Identifier: Apache-2.0
"""Damage costs what it hits and is told; what could take gigabytes or for ever is not begun."""

import sqlite3
import struct
import zlib
from contextlib import closing

import numpy as np
import pytest
from replay.recordings import GROUND, SECOND, flight, recording, storage_file
from replay.recordings import write_ros2 as write

from quadtree_lss.cli import main
from quadtree_lss.desk.bags.bag import Bag, BagError
from quadtree_lss.desk.bags.compression import zstd
from quadtree_lss.desk.replay.info import inspect_bag
from quadtree_lss.desk.replay.replay import replay as run_replay
from quadtree_lss.onboard.config.settings import config_from_values

TOPICS = ("/lidar/points", "/nav/pose")
CONFIG = config_from_values({**GROUND, "domain.max_level": 5})
SCANS = 24
WHOLE = 3 * SCANS + 2
STORAGES = {
    "mcap": {},
    "mcap, file": {"compression": "file"},
    "mcap, message": {"compression": "message"},
    "mcap, chunks": {"compression": "storage"},
    "sqlite3": {"plugin": "sqlite3"},
    "sqlite3, file": {"plugin": "sqlite3", "compression": "file"},
    "ros1": {},
    "ros1, bz2": {"compression": "BZ2"},
    "ros1, lz4": {"compression": "LZ4"},
}
CHUNK, DATA_END = 6, 15
"""Kinds of mcap records."""


def file_of(path):
    return path if path.is_file() else storage_file(path)


def chunks_of(content):
    """Place and end of each chunk of an mcap file, and the end of its data."""
    place, found = 8, []
    while True:
        kind, length = struct.unpack_from("<BQ", content, place)
        if kind == DATA_END:
            return found, place
        if kind == CHUNK:
            found.append((place, place + 9 + length))
        place += 9 + length


def with_checksums(path, **options):
    """An mcap bag as a vehicle's recorder writes it: chunks compressed, with checksums."""
    file = file_of(write(path, compression="storage", **options))
    content = bytearray(file.read_bytes())
    for place, end in chunks_of(content)[0]:
        checksum = zlib.crc32(zstd.decompress(content[place + 53 : end]))
        struct.pack_into("<I", content, place + 33, checksum)
    file.write_bytes(content)
    return path


def read(path):
    """Topic and bytes of all messages, and the losses."""
    with Bag(path) as bag:
        found = [(m.topic, bytes(m.raw)) for m in bag.messages(TOPICS)]
        return found, bag.losses


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """The file, its messages, its chunks and the end of its data."""
    folder = tmp_path_factory.mktemp("sound") / "bag"
    file = file_of(with_checksums(folder, scans=SCANS, across=150))
    found, losses = read(file)
    content = file.read_bytes()
    chunks, end = chunks_of(content)
    assert len(found) == WHOLE and not losses and len(chunks) > 5
    return content, found, [place for place, _ in chunks], end


def test_a_damaged_chunk_with_an_index_costs_only_itself(sound, tmp_path):
    content, whole, (_, _, a, b, *_), _ = sound
    middle = (a + b) // 2
    path = tmp_path / "spoilt.mcap"
    path.write_bytes(content[:middle] + bytes([content[middle] ^ 4]) + content[middle + 1 :])
    found, (line,) = read(path)
    assert WHOLE // 2 < len(found) < WHOLE and found == [m for m in whole if m in found]
    assert f"at byte {a}, {WHOLE - len(found)} of {WHOLE} messages lost" in line


@pytest.mark.parametrize("index", [True, False])
def test_a_gap_ends_reading_and_is_one_line(sound, tmp_path, index):
    content, whole, (_, _, a, b, *_), end = sound
    path = tmp_path / "spoilt.mcap"
    path.write_bytes(content[: a + 5] + content[b + 7 : None if index else end])
    found, (line,) = read(path)
    assert 0 < len(found) < WHOLE and found == whole[: len(found)] and "at byte" in line


def test_a_damaged_bag_is_exit_code_3(sound, tmp_path, capsys):
    content, _, places, _ = sound
    (tmp_path / "cut.mcap").write_bytes(content[: places[3] + 100])
    settings = [f"--set={key}={value}" for key, value in GROUND.items()]
    arguments = ["replay", tmp_path / "cut.mcap", "--out", tmp_path / "out", "--no-report"]
    assert main([*map(str, arguments), *settings]) == 3
    assert capsys.readouterr().err.count("quadtree-lss: damaged: cut.mcap: damaged or trunc") == 1


@pytest.mark.parametrize("compression", ["", "LZ4"])
def test_a_ros1_bag_is_read_on_at_the_next_chunk_of_its_index(tmp_path, compression):
    path = write(tmp_path / "flight.bag", compression=compression, scans=SCANS, across=150)
    whole, _ = read(path)
    content = path.read_bytes()
    place = [k for k in range(len(content)) if content.startswith(b"op=\x05", k)][2] - 20
    path.write_bytes(content[:place] + bytes(40) + content[place + 40 :])
    found, (line,) = read(path)
    assert WHOLE // 2 < len(found) < WHOLE and found == [m for m in whole if m in found]
    assert f"{WHOLE - len(found)} of {WHOLE} messages lost" in line


@pytest.mark.parametrize("storage", ["mcap", "sqlite3", "ros1", "mcap in one chunk"])
def test_a_recorder_clock_that_steps_back_costs_no_scan(tmp_path, storage):
    path = tmp_path / ("flight.bag" if storage == "ros1" else "flight")
    with recording(path, plugin="sqlite3" if storage == "sqlite3" else "mcap") as recorder:
        plain, number = recorder.write_raw, iter(range(10**6))
        recorder.write_raw = lambda topic, raw, kind, at: plain(
            topic, raw, kind, at - 2 * SECOND * (next(number) > 40)
        )
        flight(recorder, scans=SCANS, across=24 if "one" in storage else 150)
    result = run_replay(path, None, CONFIG)
    assert result.summary["scans"] == SCANS and not result.losses
    assert any("clock stepped back" in line for line in result.warnings)


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
@pytest.mark.parametrize("when", ["soon", 0, 2**63 - 1])
def test_one_row_with_a_bad_time_costs_nothing(tmp_path, row, when):
    query = "UPDATE messages SET timestamp = ? WHERE id = ?"
    with Bag(rows_changed(tmp_path / "bag", query, values=(when, row))) as bag:
        assert bag.end_ns - bag.start_ns < 3 * SECOND
        assert len({(m.topic, bytes(m.raw)) for m in bag.messages(TOPICS)}) == WHOLE
        (line,) = bag.losses
    assert "impossible time" in line


def test_messages_that_cannot_be_decoded_are_losses(tmp_path):
    query = "UPDATE messages SET data = substr(data, 1, 90) WHERE id IN (3, 9)"
    path = rows_changed(tmp_path / "bag", query)
    (line,) = run_replay(path, None, CONFIG).losses
    assert "2 messages of /" in line and "cannot be decoded" in line
    assert inspect_bag(path, CONFIG).losses == [line]


@pytest.mark.quick("1-10-mcap, chunks", "1-10-ros1")
@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize(("seed", "number"), [(1, 10), (2, 150)])
def test_damaged_bags_of_every_storage(storage, tmp_path, seed, number):
    """Flipped bits, zeros, cuts and doubled bytes: no exception but one line, and no hanging."""
    rng = np.random.default_rng(seed)
    path = tmp_path / ("flight.bag" if "ros1" in storage else "bag")
    write(path, scans=16, **STORAGES[storage])
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
