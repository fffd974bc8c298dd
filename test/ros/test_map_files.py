# SPDX-License-Identifier: Apache-2.0
"""Map files: whole at any moment, and nothing else is harmed."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from quadtree_lss.config.loading import load_config
from quadtree_lss.core.mapping.mapper import Mapper
from quadtree_lss.ros.map_files import (
    Checkpoints,
    MapFileError,
    WrongContentError,
    load,
    save,
    write_atomically,
)

SMALL = {
    "domain": {"xmin": -16.0, "ymin": -16.0, "size": 32.0, "min_level": 3, "max_level": 6},
}


def test_a_writer_killed_at_any_moment_leaves_a_whole_file(tmp_path):
    path, part = tmp_path / "map", tmp_path / "map.part"
    program = (
        "from pathlib import Path; import sys\n"
        "from quadtree_lss.ros.map_files import write_atomically\n"
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


def test_map_files_survive_what_disks_do(tmp_path):
    mapper = Mapper(load_config(overrides=SMALL))
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
    assert "taken up" in checkpoints.take_up(mapper)
    checkpoints.forget()
    assert "no checkpoint" in checkpoints.take_up(mapper)
    other = Mapper(load_config(overrides={**SMALL, "domain.max_level": 7}))
    save(tmp_path / "map", other)
    with pytest.raises(MapFileError, match="another domain"):
        checkpoints.take_up(mapper)
    assert (tmp_path / "map.refused").exists() and not (tmp_path / "map").exists()


def test_a_link_stays_and_what_it_points_to_is_written_and_removed(tmp_path):
    mapper = Mapper(load_config(overrides=SMALL))
    disk = tmp_path / "disk"
    disk.mkdir()
    link = tmp_path / "map"
    link.symlink_to(disk / "real")
    checkpoints = Checkpoints(link)
    checkpoints.changed()
    assert checkpoints.close(mapper) is None
    assert link.is_symlink() and [path.name for path in disk.iterdir()] == ["real"]
    checkpoints.forget()
    assert link.is_symlink() and not list(disk.iterdir())
    (disk / "real").write_bytes(b"damaged")
    with pytest.raises(MapFileError, match="set aside"):
        checkpoints.take_up(mapper)
    assert [path.name for path in disk.iterdir()] == ["real.refused"]


def test_what_is_no_file_is_neither_read_nor_replaced_nor_moved(tmp_path):
    mapper = Mapper(load_config(overrides=SMALL))
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
        with pytest.raises(MapFileError, match="left as it is"):
            checkpoints.take_up(mapper)
        checkpoints.changed()
        assert "not a file" in checkpoints.close(mapper)
        with pytest.raises(MapFileError, match="not a file"):
            checkpoints.forget()
    assert sorted(tmp_path.iterdir()) == before and (folder / "precious").exists()
    with pytest.raises(MapFileError, match="null"):
        save(tmp_path / "a\0b", mapper)


def test_a_checkpoint_that_cannot_be_read_is_left_alone(tmp_path):
    """``/proc/self/mem`` is a regular file that gives an input/output error, to root as well."""
    mapper = Mapper(load_config(overrides=SMALL))
    path = tmp_path / "map"
    path.symlink_to("/proc/self/mem")
    checkpoints = Checkpoints(path)
    with pytest.raises(MapFileError, match="Input/output error; left as it is") as caught:
        checkpoints.take_up(mapper)
    assert not isinstance(caught.value, WrongContentError)
    assert os.listdir(tmp_path) == ["map"]
    checkpoints.changed()
    assert "is not replaced" in checkpoints.close(mapper)
    path.unlink()
    assert checkpoints.close(mapper) is None, "the one before is told no more"
    assert checkpoints.written == 1 and "taken up" in checkpoints.take_up(mapper)


def test_a_write_that_fails_leaves_nothing_behind(tmp_path):
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
