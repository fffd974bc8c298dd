# SPDX-License-Identifier: Apache-2.0
"""Maps on disk: written so that a crash at any moment leaves a whole file, the old or the new."""

from __future__ import annotations

import os
import stat
import threading
import time
from pathlib import Path

from quadtree_lss.core.mapping.mapper import Mapper
from quadtree_lss.core.tree.checkpoint import (
    CheckpointError,
    State,
    from_bytes,
    to_bytes,
)
from quadtree_lss.errors import QuadtreeLssError

END_TIMEOUT_S = 5.0
"""How long a node that ends waits for a checkpoint that is being written."""


class MapFileError(QuadtreeLssError):
    """A map file cannot be written, read or used; one line that names it."""


class WrongContentError(MapFileError):
    """It can be read, but what is in it is no map, or not one of this domain."""


def regular_file(path: Path) -> Path:
    """The file a path means, links followed; it need not exist yet.

    Raises:
        MapFileError: there is something that is no regular file (a folder, a device, a pipe), or
            it cannot be looked at.
    """
    try:
        target = Path(os.path.realpath(path))
        mode = target.stat().st_mode
    except FileNotFoundError:
        return target
    except (OSError, ValueError) as error:
        raise MapFileError(_text(path, "used", error)) from None
    if not stat.S_ISREG(mode):
        kind = "folder" if stat.S_ISDIR(mode) else "device, pipe or socket"
        msg = f"{path}: is a {kind}, not a file"
        raise MapFileError(msg)
    return target


def sibling(path: Path, ending: str) -> Path:
    """The path of a `regular_file` with something behind its name."""
    return path.parent / (path.name + ending)


def _text(path: Path, done: str, error: Exception) -> str:
    reason = error.strerror if isinstance(error, OSError) else None
    return f"{path}: cannot be {done}: {reason or str(error).removeprefix(f'{path}: ')}"


def write_atomically(path: Path, content: bytes) -> None:
    """Replace the file in one step, once its new content is safely on the disk.

    A link stays one: what it points to is replaced.

    Raises:
        MapFileError: no regular file, not writable, disk full; the old file is then untouched.
    """
    target = regular_file(path)
    part = sibling(target, ".part")
    try:
        with part.open("wb") as file:
            try:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            except OSError:
                part.unlink(missing_ok=True)  # it takes the room that there is not
                raise
        part.replace(target)
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        raise MapFileError(_text(path, "written", error)) from None


def save(path: Path, mapper: Mapper) -> None:
    """Write the mapper's state.

    Raises:
        MapFileError: see `write_atomically`.
    """
    write_atomically(path, to_bytes(mapper.export_state()))


def load(path: Path, mapper: Mapper) -> None:
    """Put the mapper into the state in a file.

    Raises:
        MapFileError: not readable; the mapper is then unchanged.
        WrongContentError: damaged, of another domain; the mapper is then unchanged.
    """
    try:
        content = regular_file(path).read_bytes()
    except OSError as error:
        raise MapFileError(_text(path, "read", error)) from None
    try:
        mapper.import_state(from_bytes(content))
    except CheckpointError as error:
        msg = f"{path}: {error}"
        raise WrongContentError(msg) from None


class Checkpoints:
    """Keeps a file in step with the map; the writing is done beside the node's own work.

    A file that was there from the start and could not be read may hold a good map: it is not
    replaced.

    Args:
        path: The file; its folder must exist.

    Attributes:
        written: How often it was written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.written = 0
        self._error: str | None = None
        self._thread: threading.Thread | None = None
        self._changed = False
        self._unread = False
        self._due = time.monotonic()

    def take_up(self, mapper: Mapper) -> str:
        """Continue from the file if there is one; what became of it, for the log.

        Raises:
            MapFileError: the file cannot be used, and the mapper is unchanged. A file of wrong
                content is set aside, one that cannot be read is left alone.
        """
        try:
            target = regular_file(self.path)
            if not target.exists():
                return f"no checkpoint at {self.path} yet: starting with an empty map"
            load(self.path, mapper)
        except WrongContentError as error:
            aside = sibling(target, ".refused")
            try:
                target.replace(aside)
                done = f"set aside as {aside.name}, "
            except OSError:
                done = ""
            msg = f"checkpoint {error}; {done}starting with an empty map"
            raise MapFileError(msg) from None
        except MapFileError as error:
            self._unread = True
            msg = f"checkpoint {error}; left as it is, starting with an empty map"
            raise MapFileError(msg) from None
        return (
            f"checkpoint {self.path} taken up: {mapper.leaves.count} leaves,"
            f" newest scan {mapper.stamp_ns} ns"
        )

    def changed(self) -> None:
        """The map changed."""
        self._changed = True

    def work(self, mapper: Mapper, interval: float) -> str | None:
        """Write if it is time; call often. The answer is what went wrong with the last one."""
        if self._thread is not None and not self._thread.is_alive():
            self._thread = None
        now = time.monotonic()
        if self._thread is None and self._changed and now >= self._due:
            self._due = now + interval
            self._changed = False
            state = mapper.export_state()
            self._thread = threading.Thread(target=self._write, args=(state,), daemon=True)
            self._thread.start()
        error, self._error = self._error, None
        return error

    def forget(self) -> None:
        """Remove the file: the map was reset.

        Raises:
            MapFileError: it cannot be removed.
        """
        if not self._join():
            self._changed = True  # the empty map then replaces what is still being written
            msg = f"{self.path}: cannot be removed: it is still being written"
            raise MapFileError(msg)
        self._changed = False
        try:
            regular_file(self.path).unlink(missing_ok=True)
        except (OSError, MapFileError) as error:
            raise MapFileError(_text(self.path, "removed", error)) from None
        self._unread = False

    def close(self, mapper: Mapper) -> str | None:
        """Write what the file lacks; the answer is what went wrong."""
        if not self._join():
            return (
                f"checkpoint {self.path}: not written within {END_TIMEOUT_S:g} s; the one before is"
                " intact"
            )
        if self._changed:
            self._changed, self._error = False, None
            self._write(mapper.export_state())
        return self._error

    def _join(self) -> bool:
        """Wait for what is being written; False if it still is."""
        if self._thread is not None:
            self._thread.join(END_TIMEOUT_S)
            if self._thread.is_alive():
                return False
            self._thread = None
        return True

    def _write(self, state: State) -> None:
        try:
            if self._unread and regular_file(self.path).exists():
                msg = f"{self.path}: could not be read at the start and is not replaced"
                raise MapFileError(msg)
            write_atomically(self.path, to_bytes(state))
        except MapFileError as error:
            self._error = f"checkpoint {error}"
            self._changed = True  # the next one tries again
        else:
            self._unread = False
            self.written += 1
