# SPDX-License-Identifier: Apache-2.0
"""Files that a node keeps: replaced in one step, one keeper each.

Whoever can write to the folder may have put anything at the names used here: links, pipes, folders.
Nothing but regular files is read, replaced or waited for.
"""

from __future__ import annotations

import fcntl
import os
import stat
from collections.abc import Callable
from pathlib import Path

from quadtree_lss.onboard.errors import QuadtreeLssError

NEW = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
LOCK = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


class MapFileError(QuadtreeLssError):
    """A map file cannot be written, read or used; one line that names it."""


class InUseError(MapFileError):
    """Another program keeps this file."""


def regular_file(path: Path) -> Path:
    """The file a path means, links followed; it need not exist yet. Raises `MapFileError`: there is
    something that is no regular file (a folder, a device, a pipe), or it cannot be looked at."""
    try:
        target = Path(os.path.realpath(path))
        mode = target.stat().st_mode
    except FileNotFoundError:
        return target
    except (OSError, ValueError) as error:
        raise MapFileError(error_text(path, "used", error)) from None
    if not stat.S_ISREG(mode):
        kind = "folder" if stat.S_ISDIR(mode) else "device, pipe or socket"
        msg = f"{path}: is a {kind}, not a file"
        raise MapFileError(msg)
    return target


def sibling(path: Path, ending: str) -> Path:
    """The path of a `regular_file` with something behind its name."""
    return path.parent / (path.name + ending)


def error_text(path: Path, done: str, error: Exception) -> str:
    """``PATH: cannot be DONE: reason``."""
    reason = error.strerror if isinstance(error, OSError) else None
    return f"{path}: cannot be {done}: {reason or str(error).removeprefix(f'{path}: ')}"


def read_file(path: Path, most: int) -> bytes:
    """Content of a regular file, of which no more than ``most`` bytes. Raises `MapFileError`: it is
    none or cannot be read."""
    target = regular_file(path)
    try:
        with open(os.open(target, READ), "rb") as file:
            return file.read(most)
    except OSError as error:
        raise MapFileError(error_text(path, "read", error)) from None


def write_atomically(
    path: Path,
    content: bytes,
    *,
    verify: Callable[[bytes], None] | None = None,
    previous: str = "",
) -> None:
    """Replace the file in one step, once its new content is safely on the disk.

    A link stays one: what it points to is replaced.

    Args:
        path: As of `regular_file`.
        content: The whole new content.
        verify: Called with what can be read back before anything is replaced.
        previous: Ending under which the file that was there is kept; empty = not.

    Raises:
        MapFileError: no regular file, not writable, disk full, or another program writes it at the
            same time; the old file is then untouched.
        Exception: whatever ``verify`` raises; the same.
    """
    target = regular_file(path)
    part = sibling(target, ".part")
    try:
        # Of a writer that was killed, or put there by somebody; nobody is to follow or open it.
        part.unlink(missing_ok=True)
        with open(os.open(part, NEW, 0o666), "w+b") as file:
            try:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
                if verify is not None:
                    file.seek(0)
                    verify(file.read())
                if not os.path.samestat(os.fstat(file.fileno()), part.lstat()):
                    msg = f"{path}: another program writes it at the same time"
                    raise MapFileError(msg)
            except Exception:
                part.unlink(missing_ok=True)  # it takes the room that there may not be
                raise
        if previous and target.exists():
            target.replace(sibling(target, previous))
        part.replace(target)
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        raise MapFileError(error_text(path, "written", error)) from None


class Keeper:
    """The right to write a file, which one process has at a time, until it ends: a lock on the file
    ``<name>.lock`` beside it, which stays."""

    def __init__(self) -> None:
        self._held: int | None = None

    def claim(self, target: Path) -> None:
        """Have the right to a `regular_file` from now on. Raises `InUseError`: another process has
        it."""
        if self._held is not None:
            return
        try:
            found = os.open(sibling(target, ".lock"), LOCK, 0o666)
        except OSError:
            return  # nothing can be written there, which is for others to tell
        try:
            fcntl.flock(found, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(found)
            msg = f"{target}: another node keeps its checkpoint there"
            raise InUseError(msg) from None
        except OSError:
            pass  # a disk without locks: two nodes are not told
        self._held = found

    def release(self) -> None:
        """Let another have it."""
        if self._held is not None:
            os.close(self._held)
        self._held = None
