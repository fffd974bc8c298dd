# SPDX-License-Identifier: Apache-2.0
"""Bags of every kind and state give the same messages, as far as they are there."""

import shutil
from contextlib import closing

import pytest
from replay.recordings import CLOUD, POSE, storage_file, write_ros1, write_ros2

from quadtree_lss.desk.bags.bag import Bag, BagError
from quadtree_lss.desk.bags.mcap_file import McapFile
from quadtree_lss.desk.bags.topics import POSE_TOPIC, SCAN_TOPIC, choose_topic
from quadtree_lss.onboard.messages.clouds import MessageError, points_from_cloud, stamp_ns
from quadtree_lss.onboard.messages.poses import pose_from_message

TOPICS = {SCAN_TOPIC: CLOUD, POSE_TOPIC: POSE}
SCANS = 10


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


def file_of(path, folder):
    target = folder / storage_file(path).name
    shutil.copy(storage_file(path), target)
    return target


@pytest.mark.parametrize("plugin", ["mcap", "sqlite3"])
@pytest.mark.parametrize("compression", [None, "file", "message"])
@pytest.mark.parametrize("single", [False, True])
def test_ros2_bags_of_every_kind(tmp_path, reference, plugin, compression, single):
    path = write_ros2(tmp_path / "bag", plugin=plugin, compression=compression)
    found, losses = content(file_of(path, tmp_path) if single else path)
    assert found == reference[1] and not losses


def test_ros1_bags(tmp_path, reference):
    found, losses = content(write_ros1(tmp_path / "flight.bag"))
    assert found == reference[1] and not losses


def test_times_are_in_bag_order_and_may_be_limited(reference):
    path, found = reference
    times = [entry[1] for entry in found]
    assert times == sorted(times)
    first, last = times[5], times[20]
    part, _ = content(path, start_ns=first, stop_ns=last)
    assert part == [entry for entry in found if first <= entry[1] < last]
    with Bag(path) as bag:
        assert (bag.start_ns, bag.end_ns) == (times[0], times[-1])


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
@pytest.mark.parametrize("single", [False, True])
def test_what_is_there_of_a_truncated_mcap_is_read(tmp_path, reference, share, single):
    path = write_ros2(tmp_path / "bag")
    file = storage_file(path)
    whole = file.read_bytes()
    file.write_bytes(whole[: int(share * len(whole))])
    found, losses = content(file if single else path)
    assert found == reference[1][: len(found)]
    assert len(found) >= int(share * len(reference[1])) - 2
    assert any("truncated" in loss for loss in losses)


@pytest.mark.parametrize("share", [0.75, 0.95])
@pytest.mark.parametrize("compression", ["", "BZ2", "LZ4"])
def test_what_is_there_of_a_truncated_ros1_bag_is_read(tmp_path, share, compression):
    path = write_ros1(tmp_path / "flight.bag", scans=200, compression=compression)
    whole, _ = content(path)
    contained = path.read_bytes()
    path.write_bytes(contained[: int(share * len(contained))])
    found, losses = content(path)
    assert found == whole[: len(found)] and losses
    assert len(found) > 0.5 * share * len(whole)


@pytest.mark.parametrize("length", [1 << 40, 1 << 62, (1 << 64) - 1])
@pytest.mark.parametrize("opcode", [0x05, 0x06, 0x08], ids=["message", "chunk", "index"])
def test_a_record_of_impossible_length_ends_an_mcap_file(tmp_path, opcode, length):
    path = write_ros2(tmp_path / "bag")
    whole, _ = content(path)
    file = storage_file(path)
    with closing(McapFile(file)) as good:
        assert len(list(good.messages(None))) == len(whole) and not good.losses
    intact = file.read_bytes()
    end = intact.rindex(b"\x0f" + (4).to_bytes(8, "little"))  # the record that ends the data
    damaged = intact[:end] + bytes([opcode]) + length.to_bytes(8, "little") + intact[end + 9 :]
    file.write_bytes(damaged[:-20])  # without its end the index is not found
    found, losses = content(file)
    assert found == whole
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


def test_a_truncated_compressed_file_is_read_as_far_as_it_goes(tmp_path):
    path = write_ros2(tmp_path / "bag", compression="file", scans=100)
    complete, _ = content(path)
    file = storage_file(path)
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    found, losses = content(path)
    assert found == complete[: len(found)] and losses and len(found) > 20


@pytest.mark.parametrize("suffix", [".mcap", ".db3", ".bag", ".txt", ".mcap.zstd"])
@pytest.mark.parametrize("junk", [b"", b"no bag at all " * 100])
def test_files_that_are_no_bags_give_one_line(tmp_path, suffix, junk):
    path = tmp_path / f"file{suffix}"
    path.write_bytes(junk)
    with pytest.raises(BagError) as caught, Bag(path):
        pass
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_an_empty_directory_and_one_with_missing_files(tmp_path):
    with pytest.raises(BagError, match="no bag"), Bag(tmp_path):
        pass
    path = write_ros2(tmp_path / "bag")
    storage_file(path).unlink()
    with pytest.raises(BagError), Bag(path):
        pass


def test_bytes_that_are_no_message_give_a_message_error(reference):
    path, _ = reference
    with Bag(path) as bag:
        good = next(bag.messages([SCAN_TOPIC])).raw
        for raw in (b"", good[:3], good[:40], b"\xff" * 200, b"\x28\xb5\x2f\xfd" + good):
            with pytest.raises(MessageError):
                bag.decode(raw, CLOUD)


def chosen(path, asked=None):
    with Bag(path) as bag:
        return choose_topic(bag, asked, SCAN_TOPIC, CLOUD, "--scan-topic")


def test_topics_are_found_by_name_then_by_type(tmp_path, reference):
    assert chosen(reference[0]) == SCAN_TOPIC
    both = write_ros2(tmp_path / "both", scan_topics=(SCAN_TOPIC, "/camera/points"))
    assert chosen(both) == SCAN_TOPIC
    assert chosen(both, "/camera/points") == chosen(both, "camera/points") == "/camera/points"
    other = write_ros2(tmp_path / "other", scan_topics=("/os1/points",))
    assert chosen(other) == "/os1/points"


def test_ambiguous_and_missing_topics_list_the_candidates(tmp_path, reference):
    two = write_ros2(tmp_path / "two", scan_topics=("/left", "/right"))
    with pytest.raises(BagError, match="--scan-topic: /left, /right"):
        chosen(two)
    none = write_ros2(tmp_path / "none", scan_topics=())
    with pytest.raises(BagError, match="/nav/pose"):
        chosen(none)
    for wrong in ("/nothing", POSE_TOPIC):
        with pytest.raises(BagError, match=SCAN_TOPIC):
            chosen(reference[0], wrong)
