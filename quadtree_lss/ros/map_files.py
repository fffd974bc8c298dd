# SPDX-License-Identifier: Apache-2.0
"""Maps on disk: written so that a crash at any moment leaves a whole file, the old or the new."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

from quadtree_lss.core.checkpoint import (
    CheckpointError,
    State,
    export_checkpoint,
    from_bytes,
    restore,
    to_bytes,
)
from quadtree_lss.core.mapping import Mapper
from quadtree_lss.errors import QuadtreeLssError

END_TIMEOUT_S = 5.0
"""How long a node that ends waits for a checkpoint that is being written."""


class MapFileError(QuadtreeLssError):
    """A map file cannot be written, read or used; one line that names it."""


def write_atomically(path: Path, content: bytes) -> None:
    """Replace the file in one step, once its new content is safely on the disk.

    Raises:
        MapFileError: not writable, disk full; the old file is then untouched.
    """
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        msg = f"{path}: cannot be written: {error.strerror or error}"
        raise MapFileError(msg) from None


def save(path: Path, mapper: Mapper) -> None:
    """Write the mapper's state.

    Raises:
        MapFileError: see `write_atomically`.
    """
    write_atomically(path, to_bytes(export_checkpoint(mapper)))


def load(path: Path, mapper: Mapper) -> None:
    """Put the mapper into the state in a file.

    Raises:
        MapFileError: not readable, damaged, of another domain; the mapper is then unchanged.
    """
    try:
        restore(mapper, from_bytes(path.read_bytes()))
    except OSError as error:
        msg = f"{path}: cannot be read: {error.strerror or error}"
        raise MapFileError(msg) from None
    except CheckpointError as error:
        msg = f"{path}: {error}"
        raise MapFileError(msg) from None


class Checkpoints:
    """Keeps a file in step with the map; the writing is done beside the node's own work.

    Args:
        path: The file; its folder must exist.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.written = 0
        self._error: str | None = None
        self._thread: threading.Thread | None = None
        self._changed = False
        self._due = time.monotonic()

    def take_up(self, mapper: Mapper) -> str:
        """Continue from the file if there is one; what became of it, for the log.

        Raises:
            MapFileError: the file cannot be used. It is set aside, and the mapper unchanged.
        """
        if not self.path.exists():
            return f"no checkpoint at {self.path} yet: starting with an empty map"
        try:
            load(self.path, mapper)
        except MapFileError as error:
            aside = self.path.with_name(self.path.name + ".refused")
            try:
                self.path.replace(aside)
                msg = f"checkpoint {error}; set aside as {aside.name}, starting with an empty map"
            except OSError:
                msg = f"checkpoint {error}; starting with an empty map"
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
            state = export_checkpoint(mapper)
            self._thread = threading.Thread(target=self._write, args=(state,), daemon=True)
            self._thread.start()
        error, self._error = self._error, None
        return error

    def forget(self) -> None:
        """Remove the file: the map was reset.

        Raises:
            MapFileError: it cannot be removed.
        """
        self._join()
        self._changed = False
        try:
            self.path.unlink(missing_ok=True)
        except OSError as error:
            msg = f"{self.path}: cannot be removed: {error.strerror or error}"
            raise MapFileError(msg) from None

    def close(self, mapper: Mapper) -> str | None:
        """Write what the file lacks; the answer is what went wrong."""
        self._join()
        if self._changed:
            self._changed = False
            self._write(export_checkpoint(mapper))
        return self._error

    def _join(self) -> None:
        if self._thread is not None:
            self._thread.join(END_TIMEOUT_S)
            self._thread = None

    def _write(self, state: State) -> None:
        try:
            write_atomically(self.path, to_bytes(state))
        except MapFileError as error:
            self._error = f"checkpoint {error}"
            self._changed = True  # the next one tries again
        else:
            self.written += 1
