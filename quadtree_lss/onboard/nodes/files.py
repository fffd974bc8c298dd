# SPDX-License-Identifier: Apache-2.0
"""Map files: atomic replacement, regular files only."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from quadtree_lss.onboard.errors import QuadtreeLssError


class MapFileError(QuadtreeLssError):
    """A map file cannot be written, read or used; the text is one line that names it."""


def regular_file(path: Path) -> Path:
    """Resolve links to a file, which need not exist. Raises `MapFileError` if it is not a regular
    file (a folder, device or pipe) or not accessible."""
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
