# SPDX-License-Identifier: Apache-2.0
"""Bags of every kind and state give the same messages, as far as they are there."""

import contextlib
import sqlite3
import struct
from functools import partial

import pytest
from replay.recordings import (
    CLOUD,
    POSE,
    flight,
    recording,
    storage_file,
    write_ros2,
)

from quadtree_lss.desk.bags.bag import Bag, BagError
from quadtree_lss.desk.bags.compression import zstd
from quadtree_lss.desk.bags.topics import POSE_TOPIC, SCAN_TOPIC, choose_topic
from quadtree_lss.onboard.messages.clouds import MessageError, points_from_cloud, stamp_ns
from quadtree_lss.onboard.messages.poses import pose_from_message

END = struct.pack("<BQ", 15, 4)
"""The record that ends the data of an mcap file."""
TOPICS = {SCAN_TOPIC: CLOUD, POSE_TOPIC: POSE}
SCANS = 10
KINDS = [
    ("bag", {"plugin": plugin, "compression": compression}, single)
    for plugin in ("mcap", "sqlite3")
    for compression in (None, "file", "message", "storage")[: 4 if plugin == "mcap" else 3]
    for single in (False, True)
]
KINDS += [
    ("flight.bag", {"compression": compression}, False) for compression in (None, "LZ4", "BZ2")
]


def content(path, **limits):
    """Stamps, first points or positions of all messages, and the losses."""
    found = []
    with Bag(path) as bag:
        for message in bag.messages(list(TOPICS), **limits):
            msg = bag.decode(message.raw, TOPICS[message.topic])
            if message.topic == SCAN_TOPIC:
                value = points_from_cloud(msg)[0, 0]
            else:
                value = pose_from_message(msg, "map").position
            found.append((message.topic, message.received_ns, stamp_ns(msg.header), *value))
        return found, bag.losses


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    path = write_ros2(tmp_path_factory.mktemp("reference") / "bag")
    found, losses = content(path)
    assert len(found) == 3 * SCANS + 2 and not losses
    return path, found


@pytest.mark.parametrize(("name", "how", "single"), KINDS)
def test_bags_of_every_kind(tmp_path, reference, name, how, single):
    path = write_ros2(tmp_path / name, **how)
    found, losses = content(storage_file(path) if single else path)
    assert found == reference[1] and not losses


def packed(file):
    copy = file.with_name(f"{file.name}.zstd")
    copy.write_bytes(zstd.compress(file.read_bytes()))
    return copy


CHANGES = {
    "renamed": lambda file: file.rename(file.with_name("monday.mcap")),
    "packed": lambda file: packed(file) and file.unlink(),
    "packed copy": packed,
    "packed copy, no metadata": lambda file: packed(file).with_name("metadata.yaml").unlink(),
}


@pytest.mark.parametrize("change", CHANGES)
def test_files_that_were_renamed_or_packed_since_are_found_and_read_once(
    tmp_path, reference, change
):
    path = write_ros2(tmp_path / "bag")
    CHANGES[change](storage_file(path))
    assert content(path) == (reference[1], [])


def without_index(file):
    intact = file.read_bytes()
    end = struct.pack("<BQI", 15, 4, 0) + struct.pack("<BQQQI", 2, 20, 0, 0, 0)
    file.write_bytes(intact[: intact.rindex(END)] + end + intact[-8:])


def of_foxy(file):
    with contextlib.closing(sqlite3.connect(file)) as database:
        for column in ("offered_qos_profiles", "type_description_hash"):
            database.execute(f"ALTER TABLE topics DROP COLUMN {column}")
        for table in ("schema", "metadata", "message_definitions"):
            database.execute(f"DROP TABLE {table}")


@pytest.mark.parametrize(("plugin", "change"), [("mcap", without_index), ("sqlite3", of_foxy)])
def test_files_without_an_index_or_of_an_old_format_are_sound(tmp_path, reference, plugin, change):
    path = write_ros2(tmp_path / "bag", plugin=plugin)
    change(storage_file(path))
    assert content(path) == (reference[1], [])


def of_encoding(path, encoding, recode):
    """A `flight` in mcap with messages of another encoding. ``recode``: makes them."""
    ros1 = encoding == "ros1"
    with recording(path) as recorder:
        recorder.__init__(recorder.writer, ros1)
        plain = recorder.writer.add_connection
        recorder.writer.add_connection = partial(plain, serialization_format=encoding)
        recorder.write = lambda topic, message, kind, at: recorder.write_raw(
            topic, recode(recorder.store, message, kind), kind, at
        )
        flight(recorder)
    return path


ENCODED = {
    "ros1": lambda store, message, kind: store.serialize_ros1(message, kind),
    "cdr": lambda store, message, kind: store.serialize_cdr(message, kind, little_endian=False),
}


@pytest.mark.parametrize("encoding", ENCODED)
def test_ros1_messages_and_big_endian_ones_in_mcap_are_decoded(tmp_path, reference, encoding):
    path = of_encoding(tmp_path / "bag", encoding, ENCODED[encoding])
    assert content(path) == (reference[1], [])


def test_times_are_in_bag_order_and_may_be_limited(reference):
    path, found = reference
    times = [entry[1] for entry in found]
    assert times == sorted(times)
    first, last = times[5], times[20]
    part, _ = content(path, start_ns=first, stop_ns=last)
    assert part == [entry for entry in found if first <= entry[1] < last]
    with Bag(path) as bag:
        assert (bag.start_ns, bag.end_ns) == (times[0], times[-1])


TRUNCATED = [("bag", {}, share) for share in (0.3, 0.6, 0.95)]
TRUNCATED += [
    ("flight.bag", {"compression": compression, "scans": 200}, share)
    for compression in ("", "LZ4")
    for share in (0.75, 0.95)
]
TRUNCATED += [("bag", {"compression": "file", "scans": 100}, 0.5)]


@pytest.mark.parametrize(("name", "how", "share"), TRUNCATED)
def test_what_is_there_of_a_truncated_bag_is_read(tmp_path, name, how, share):
    path = write_ros2(tmp_path / name, **how)
    complete, _ = content(path)
    file = path if path.is_file() else storage_file(path)
    whole = file.read_bytes()
    file.write_bytes(whole[: int(share * len(whole))])
    found, losses = content(path)
    least = int(share * len(complete)) - 2
    if how:  # chunks are lost as a whole, and of one compressed as a whole the blocks
        least = 0.5 * share * len(complete)
    assert found == complete[: len(found)] and len(found) >= least
    assert any("truncated" in loss for loss in losses)


def test_a_damaged_sqlite_file_gives_its_readable_rows(tmp_path):
    path = write_ros2(tmp_path / "bag", plugin="sqlite3", scans=60)
    whole, _ = content(path)
    file = storage_file(path)
    damaged = bytearray(file.read_bytes())
    half = len(damaged) // 2 // 4096 * 4096
    damaged[half : half + 8 * 4096] = bytes(8 * 4096)
    file.write_bytes(damaged)
    found, losses = content(path)
    assert 0.5 * len(whole) < len(found) < len(whole)
    assert set(found) <= set(whole) and losses


@pytest.mark.parametrize("suffix", [".mcap", ".db3", ".bag", ".txt", ".mcap.zstd"])
@pytest.mark.parametrize("junk", [b"", b"no bag at all " * 100])
def test_files_that_are_no_bags_give_one_line(tmp_path, suffix, junk):
    path = tmp_path / f"file{suffix}"
    path.write_bytes(junk)
    with pytest.raises(BagError) as caught, Bag(path):
        pass
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_bytes_that_are_no_message_give_a_message_error(reference):
    path, _ = reference
    with Bag(path) as bag:
        good = next(bag.messages([SCAN_TOPIC])).raw
        for raw in (b"", good[:3], good[:40], b"\xff" * 200, b"\x28\xb5\x2f\xfd" + good):
            with pytest.raises(MessageError):
                bag.decode(raw, CLOUD)


TWO = [SCAN_TOPIC, "/camera/points"]
FOUND = [([SCAN_TOPIC], None), (TWO, None), (TWO, "/camera/points"), (TWO, "camera/points")]
FOUND += [(["/os1/points"], None)]
LISTED = [(["/left", "/right"], None, "--scan-topic: /left, /right"), ([], None, "/nav/pose")]
LISTED += [([SCAN_TOPIC], wrong, SCAN_TOPIC) for wrong in ("/nothing", POSE_TOPIC)]


@pytest.mark.parametrize(("scans", "asked", "listed"), [(*case, "") for case in FOUND] + LISTED)
def test_topics_are_found_by_name_then_by_type_else_listed(tmp_path, scans, asked, listed):
    with Bag(write_ros2(tmp_path / "bag", scan_topics=scans, scans=1)) as bag:
        if listed:
            with pytest.raises(BagError, match=listed):
                choose_topic(bag, asked, SCAN_TOPIC, "--scan-topic")
        else:
            expected = scans[0] if asked is None else "/camera/points"
            assert choose_topic(bag, asked, SCAN_TOPIC, "--scan-topic") == expected
