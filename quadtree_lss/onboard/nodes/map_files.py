# SPDX-License-Identifier: Apache-2.0
"""The map on disk: a mapper's state to a file and back, and checkpoints while a node runs."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

from quadtree_lss.onboard.config.sections import CHECKPOINT_S
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.tree.checkpoint import CheckpointError, check, from_bytes, to_bytes
from quadtree_lss.onboard.core.tree.leaves import LEAF
from quadtree_lss.onboard.nodes.files import (
    InUseError,
    Keeper,
    MapFileError,
    error_text,
    read_file,
    regular_file,
    sibling,
    write_atomically,
)

END_TIMEOUT_S = 5.0
"""How long a node that ends waits for a checkpoint that is being written."""

PREVIOUS, REFUSED = ".previous", ".refused"

OVERHEAD = 1_000_000
"""Of an archive, in bytes, over the leaves and what is kept of finest cells."""
FINEST = 9
"""Bytes that are kept of each of these."""


class WrongContentError(MapFileError):
    """It can be read, but what is in it is no map, or not one of this domain."""


def save(path: Path, mapper: Mapper) -> None:
    """Write the mapper's state. Raises `MapFileError`: see `writer`."""
    writer(path, mapper)()


def writer(path: Path, mapper: Mapper, previous: str = "") -> Callable[[], None]:
    """What replaces the file by the mapper's present state, to be called beside its own work.

    The state is read back from the disk first, and must be one that a mapper can go on from.
    ``path``, ``previous``: as of `write_atomically`. ``mapper``: its state is copied now.
    Raises `MapFileError`: (when called) not writable, or no state to go on from; the old file is
    then untouched.
    """
    state, domain, cells = mapper.export_state(), mapper.domain, mapper.config.mapping.max_cells

    def write() -> None:
        content = to_bytes(state)
        try:
            write_atomically(path, content, verify=verify, previous=previous)
        except CheckpointError as error:
            msg = f"{path}: not written, for what would be in it {error}"
            raise MapFileError(msg) from None

    def verify(found: bytes) -> None:
        check(from_bytes(found), state, domain, cells)

    return write


def load(path: Path, mapper: Mapper) -> None:
    """Put the mapper into the state in a file.

    Raises:
        MapFileError: not readable; the mapper is then unchanged.
        WrongContentError: damaged, of another domain; the mapper is then unchanged.
    """
    cells, finest = mapper.config.mapping.max_cells, 4**mapper.domain.max_level
    most = cells * LEAF.itemsize + finest * FINEST + OVERHEAD
    content = read_file(path, most + 1)
    if len(content) > most:
        msg = f"{path}: is larger than any map of this configuration, {most} bytes"
        raise WrongContentError(msg)
    try:
        mapper.import_state(from_bytes(content))
    except CheckpointError as error:
        msg = f"{path}: {error}"
        raise WrongContentError(msg) from None


class Checkpoints:
    """Keeps a file in step with the map; the writing is done beside the node's own work.

    Each is verified before it replaces the one before, which is kept as ``<name>.previous`` for
    when the newest cannot be read. A file that was there from the start and could not be read may
    hold a good map: it is not replaced. Nor is one that another node keeps: ``foreign`` says why
    nothing is read or written here for good. ``written`` counts. With an empty ``path`` nothing is
    kept.
    """

    def __init__(self, path: str | Path) -> None:
        self._none = path == ""
        self.path = Path(path)
        self.written = 0
        self.foreign = ""
        self._keeper = Keeper()
        self._error: str | None = None
        self._thread: threading.Thread | None = None
        self._changed = False
        self._unread = False
        self._due = time.monotonic()

    def take_up(self, mapper: Mapper) -> str:
        """Continue from the file if there is one; what became of it, for the log. Raises
        `MapFileError`: the file cannot be used. The one before is taken up then, or the mapper is
        unchanged. A file of wrong content is set aside, one that cannot be read is left alone."""
        if self._none:
            return ""
        target = self._claimed()
        troubles = []
        for path in (target, sibling(target, PREVIOUS)):
            try:
                if not path.exists():
                    continue
                load(path, mapper)
            except MapFileError as error:
                left = self._leave(target, error) if path == target else ""
                troubles.append(f"{error}{left}")
                continue
            text = f"{mapper.leaves.count} leaves, newest scan {mapper.stamp_ns} ns"
            text = "; ".join([*troubles, f"{path} taken up: {text}"])
            if troubles:
                msg = f"checkpoint {text}"
                raise MapFileError(msg)
            return f"checkpoint {text}"
        if troubles:
            msg = f"checkpoint {'; '.join(troubles)}; starting with an empty map"
            raise MapFileError(msg)
        return f"no checkpoint at {self.path} yet: starting with an empty map"

    def _claimed(self) -> Path:
        """The file, which no other node keeps. Raises `MapFileError`: another does, or it can be
        none."""
        try:
            target = regular_file(self.path)
            self._keeper.claim(target)
        except InUseError as error:
            self.foreign = f"checkpoint {error}: none is taken up or written here"
            msg = f"{self.foreign}, starting with an empty map"
            raise MapFileError(msg) from None
        except MapFileError as error:
            self._unread = True
            msg = f"checkpoint {error}; left as it is, starting with an empty map"
            raise MapFileError(msg) from None
        return target

    def _leave(self, target: Path, error: MapFileError) -> str:
        """What becomes of a file that cannot be used."""
        if not isinstance(error, WrongContentError):
            self._unread = True
            return "; left as it is"
        aside = sibling(target, REFUSED)
        try:
            target.replace(aside)
        except OSError:
            return ""
        return f"; set aside as {aside.name}"

    def changed(self) -> None:
        """The map changed."""
        self._changed = not (self.foreign or self._none)

    def work(self, mapper: Mapper) -> str | None:
        """Write if it is time; call often. The answer is what went wrong with the last one."""
        if self._thread is not None and not self._thread.is_alive():
            self._thread = None
        now = time.monotonic()
        if self._thread is None and self._changed and now >= self._due:
            self._due = now + CHECKPOINT_S
            self._changed = False
            write = writer(self.path, mapper, PREVIOUS)
            self._thread = threading.Thread(target=self._write, args=(write,), daemon=True)
            self._thread.start()
        error, self._error = self._error, None
        return error

    def forget(self) -> None:
        """Remove the file and the one before: the map was reset. Raises `MapFileError`: they cannot
        be removed."""
        if self.foreign or self._none:
            return
        if not self._join():
            self._changed = True  # the empty map then replaces what is still being written
            msg = f"{self.path}: cannot be removed: it is still being written"
            raise MapFileError(msg)
        self._changed = False
        try:
            target = regular_file(self.path)
            sibling(target, PREVIOUS).unlink(missing_ok=True)
            target.unlink(missing_ok=True)
        except (OSError, MapFileError) as error:
            raise MapFileError(error_text(self.path, "removed", error)) from None
        self._unread = False

    def close(self, mapper: Mapper) -> str | None:
        """Write what the file lacks and let others have it; the answer is what went wrong."""
        if not self._join():
            return (
                f"checkpoint {self.path}: not written within {END_TIMEOUT_S:g} s; the one before is"
                " intact"
            )
        if self._changed:
            self._changed, self._error = False, None
            self._write(writer(self.path, mapper, PREVIOUS))
        self._keeper.release()
        return self._error

    def _join(self) -> bool:
        """Wait for what is being written; False if it still is."""
        if self._thread is not None:
            self._thread.join(END_TIMEOUT_S)
            if self._thread.is_alive():
                return False
            self._thread = None
        return True

    def _write(self, write: Callable[[], None]) -> None:
        try:
            if self._unread and regular_file(self.path).exists():
                msg = f"{self.path}: could not be read at the start and is not replaced"
                raise MapFileError(msg)
            write()
        except Exception as error:  # in a thread of its own nobody else would tell
            known = isinstance(error, MapFileError)
            self._error = f"checkpoint {error}" if known else f"checkpoint {self.path}: {error!r}"
            self._changed = True  # the next one tries again
        else:
            self._unread = False
            self.written += 1
