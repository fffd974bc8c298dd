# SPDX-License-Identifier: Apache-2.0
"""Map files are complete at any time, and other files are not changed."""

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from ros_scene import COVARIANCE, POSITION, ROTATION, events

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.nodes.map_files import (
    Checkpoints,
    MapFileError,
    load,
    save,
    write_atomically,
)


def small(max_level=6):
    """Mapper with the domain of the nodes in these tests."""
    domain = {"xmin": -16.0, "ymin": -16.0, "size": 32.0, "min_level": 3, "max_level": max_level}
    return Mapper(load_config(overrides={"domain": domain}))


def test_killed_writer_leaves_a_complete_file(tmp_path):
    path, part = tmp_path / "map", tmp_path / "map.part"
    program = (
        "from pathlib import Path; import sys\n"
        "from quadtree_lss.onboard.nodes.map_files import write_atomically\n"
        "while True:\n"
        "    for letter in (b'a', b'b'):\n"
        "        write_atomically(Path(sys.argv[1]), letter * 30_000_000)\n"
    )
    killed_while_writing = 0
    for _ in range(6):
        child = subprocess.Popen([sys.executable, "-c", program, str(path)], cwd=tmp_path)
        while not path.exists() or not part.exists():
            assert child.poll() is None
            time.sleep(0.002)
        child.send_signal(signal.SIGKILL)
        child.wait()
        killed_while_writing += part.exists()
        content = path.read_bytes()
        assert len(content) == 30_000_000 and len(set(content[:: 10**6] + content[-1:])) == 1
    assert killed_while_writing, "at least one was in the middle"
    write_atomically(path, b"new")
    assert path.read_bytes() == b"new" and not part.exists()


def test_map_files_survive_disk_faults(tmp_path):
    mapper = small()
    file = tmp_path / "file"
    file.write_text("x")
    for path in (tmp_path / "none" / "map", file / "map", tmp_path):
        with pytest.raises(MapFileError, match=str(path)):
            save(path, mapper)
        with pytest.raises(MapFileError, match=str(path)):
            load(path, mapper)
    checkpoints = Checkpoints(tmp_path / "map")
    checkpoints.changed()
    assert checkpoints.close(mapper) is None and checkpoints.written == 1
    assert "taken up" in checkpoints.restore(mapper)
    checkpoints.remove()
    assert "no checkpoint" in checkpoints.restore(mapper)
    save(tmp_path / "map", small(max_level=7))
    with pytest.raises(MapFileError, match="another domain.*starting with an empty map"):
        checkpoints.restore(mapper)
    assert (tmp_path / "map.refused").exists() and not (tmp_path / "map").exists()


def test_only_regular_files_are_read_or_replaced(tmp_path):
    mapper = small()
    folder, pipe, device = tmp_path / "folder", tmp_path / "pipe", tmp_path / "device"
    folder.mkdir()
    (folder / "precious").touch()
    os.mkfifo(pipe)
    device.symlink_to("/dev/null")
    before = sorted(tmp_path.iterdir())
    for path in (folder, pipe, device, Path("/"), Path(), folder / ".."):
        for use in (save, load):
            with pytest.raises(MapFileError, match="not a file"):
                use(path, mapper)
        checkpoints = Checkpoints(path)
        with pytest.raises(MapFileError, match="starting with an empty map"):
            checkpoints.restore(mapper)
        checkpoints.changed()
        assert "not a file" in checkpoints.close(mapper)
        with pytest.raises(MapFileError, match="not a file"):
            checkpoints.remove()
    assert sorted(tmp_path.iterdir()) == before and (folder / "precious").exists()
    with pytest.raises(MapFileError, match="null"):
        save(tmp_path / "a\0b", mapper)


def test_failed_write_leaves_no_file(tmp_path):
    path = tmp_path / "map"
    write_atomically(path, b"old")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
    try:
        with pytest.raises(MapFileError, match="File too large"):
            write_atomically(path, b"x" * 20_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["map"]


def kept(path, scans):
    """Return checkpoints after one for each of ``scans`` scans, and their mapper."""
    mapper = small()
    checkpoints = Checkpoints(path)
    for event in events(scans):
        if event.points_lidar is not None:
            pose = Pose(event.stamp_ns, POSITION, ROTATION, COVARIANCE)
            mapper.update(event.points_lidar, pose)
            checkpoints.changed()
            assert checkpoints.close(mapper) is None
    return checkpoints, mapper


@pytest.mark.parametrize("name", ["range_part", "pose_part"])
@pytest.mark.parametrize("value", [-1.0, np.nan, "indefinite"])
def test_broken_map_never_replaces_a_checkpoint(tmp_path, name, value):
    path = tmp_path / "map"
    checkpoints, mapper = kept(path, 2)
    good = path.read_bytes()
    row = int(np.flatnonzero(mapper.leaves.rows["state"][: mapper.leaves.count] == 3)[0])
    covariance = mapper.leaves.rows[name][row].reshape(3, 3)
    if value == "indefinite":  # the small variances alone: a large one beside must not hide it
        covariance[2, 2] = 1e6
        covariance[0, 1] = covariance[1, 0] = 1.1 * np.sqrt(covariance[0, 0] * covariance[1, 1])
    else:
        covariance[1, 1] = value
    checkpoints.changed()
    error = checkpoints.close(mapper)
    assert error is not None and "not written" in error and "impossible plane" in error
    with pytest.raises(MapFileError, match="impossible plane"):
        save(path, mapper)
    assert path.read_bytes() == good and checkpoints.written == 2
    assert os.listdir(tmp_path) == ["map"]
