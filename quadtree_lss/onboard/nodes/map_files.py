# SPDX-License-Identifier: Apache-2.0
"""Map files and checkpoints: atomic replacement, regular files only."""

from __future__ import annotations

import os
import stat
import threading
import time
from collections.abc import Callable
from pathlib import Path

from quadtree_lss.onboard.config.sections import CHECKPOINT_S
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.tree.checkpoint import CheckpointError, check, from_file, to_bytes
from quadtree_lss.onboard.errors import QuadtreeLssError

END_TIMEOUT_S = 5.0
"""Time for which a node that exits waits for a checkpoint that is being written."""


class MapFileError(QuadtreeLssError):
    """A map file cannot be written, read or used; the text is one line that names it."""


def regular_file(path: Path) -> Path:
    """Resolve links to a file, which need not exist. Raises `MapFileError` if it is another kind of
    file or not accessible."""
    try:
        target = Path(os.path.realpath(path))
        mode = target.stat().st_mode
    except FileNotFoundError:
        return target
    except (OSError, ValueError) as error:
        raise MapFileError(error_text(path, "used", error)) from None
    if not stat.S_ISREG(mode):
        msg = f"{path}: is a folder, device, pipe or socket, not a file"
        raise MapFileError(msg)
    return target


def error_text(path: Path, done: str, error: Exception) -> str:
    """Return ``PATH: cannot be DONE: reason``."""
    reason = error.strerror if isinstance(error, OSError) else None
    return f"{path}: cannot be {done}: {reason or str(error).removeprefix(f'{path}: ')}"


def write_atomically(path: Path, content: bytes) -> None:
    """Replace a file atomically after its new content is on the disk. Links are followed. Raises
    `MapFileError` if it is not a regular file, not writable, or the disk is full; the old file is
    then intact."""
    target = regular_file(path)
    part = target.with_name(f"{target.name}.part")
    try:
        try:
            with part.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            part.replace(target)
        except OSError:
            part.unlink(missing_ok=True)  # a full disk needs the space
            raise
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        raise MapFileError(error_text(path, "written", error)) from None


def save(path: Path, mapper: Mapper) -> None:
    """Write the mapper's state. Raises `MapFileError` as `writer`."""
    writer(path, mapper)()


def writer(path: Path, mapper: Mapper) -> Callable[[], None]:
    """Copy the mapper's state, and return a function that checks and writes the copy in any thread.
    It raises `MapFileError` if the file is not writable or the map is not plausible; the old file
    is then intact."""
    state, domain, cells = mapper.export_state(), mapper.domain, mapper.config.mapping.max_cells

    def write() -> None:
        try:
            check(state, state, domain, cells)
        except CheckpointError as error:
            msg = f"{path}: not written: the map {error}"
            raise MapFileError(msg) from None
        write_atomically(path, to_bytes(state))

    return write


def load(path: Path, mapper: Mapper) -> None:
    """Replace the mapper's state by that of a file. Raises `MapFileError` if the file is not
    readable, damaged or of a different domain; the mapper is then unchanged."""
    try:
        with regular_file(path).open("rb") as file:
            mapper.import_state(from_file(file))
    except CheckpointError as error:
        msg = f"{path}: {error}"
        raise MapFileError(msg) from None
    except OSError as error:
        raise MapFileError(error_text(path, "read", error)) from None


class Checkpoints:
    """Write the map to a file periodically, in a thread; not if ``path`` is empty. A file that
    cannot be used at the start is renamed to ``<name>.refused``, so that it is not overwritten.
    ``written``: number of checkpoints."""

    def __init__(self, path: str | Path) -> None:
        self._is_enabled = path != ""
        self.path = Path(path)
        self.written = 0
        self._error: str | None = None
        self._thread: threading.Thread | None = None
        self._changed = False
        self._due = time.monotonic()

    def restore(self, mapper: Mapper) -> str:
        """Load the file if there is one; return a line for the log. Raises `MapFileError` if the
        file cannot be used; the mapper is then unchanged."""
        if not self._is_enabled:
            return ""
        try:
            if not regular_file(self.path).exists():
                return f"no checkpoint at {self.path} yet: starting with an empty map"
            load(self.path, mapper)
        except MapFileError as error:
            msg = f"checkpoint {error}{self._set_aside()}; starting with an empty map"
            raise MapFileError(msg) from None
        text = f"{mapper.leaves.count} leaves, newest scan {mapper.stamp_ns} ns"
        return f"checkpoint {self.path} taken up: {text}"

    def _set_aside(self) -> str:
        try:
            target = regular_file(self.path)
            aside = target.replace(target.with_name(f"{target.name}.refused"))
        except (OSError, MapFileError):
            return ""
        return f"; set aside as {aside.name}"

    def changed(self) -> None:
        """Note that the map changed."""
        self._changed = self._is_enabled

    def write_if_due(self, mapper: Mapper) -> str | None:
        """Start a checkpoint if one is due; return the error of the last one, if any."""
        now, is_writing = time.monotonic(), self._thread is not None and self._thread.is_alive()
        if self._changed and now >= self._due and not is_writing:
            self._due, self._changed = now + CHECKPOINT_S, False
            write = writer(self.path, mapper)
            self._thread = threading.Thread(target=self._write, args=(write,), daemon=True)
            self._thread.start()
        error, self._error = self._error, None
        return error

    def remove(self) -> None:
        """Remove the file after a reset of the map. Raises `MapFileError` if that fails."""
        if not self._is_enabled:
            return
        if not self._join():
            self._changed = True  # so that the empty map replaces the checkpoint in progress
            msg = f"{self.path}: cannot be removed: it is still being written"
            raise MapFileError(msg)
        self._changed = False
        try:
            regular_file(self.path).unlink(missing_ok=True)
        except OSError as error:
            raise MapFileError(error_text(self.path, "removed", error)) from None

    def close(self, mapper: Mapper) -> str | None:
        """Write the last changes; return the error, if any."""
        if not self._join():
            limit = f"{END_TIMEOUT_S:g} s"
            return f"checkpoint {self.path}: not written within {limit}; the one before is intact"
        if self._changed:
            self._changed, self._error = False, None
            self._write(writer(self.path, mapper))
        return self._error

    def _join(self) -> bool:
        """Wait for the checkpoint in progress; return False if it is still being written."""
        if self._thread is None:
            return True
        self._thread.join(END_TIMEOUT_S)
        return not self._thread.is_alive()

    def _write(self, write: Callable[[], None]) -> None:
        try:
            write()
        except Exception as error:  # an error of this thread would not be reported otherwise
            known = isinstance(error, MapFileError)
            self._error = f"checkpoint {error}" if known else f"checkpoint {self.path}: {error!r}"
            self._changed = True  # the next one tries again
        else:
            self.written += 1
