# SPDX-License-Identifier: Apache-2.0
"""Writing of result files: each file is replaced atomically, so that readers never see a part of it
and a failed run keeps the earlier files."""

from __future__ import annotations

import csv
import fcntl
import io
import json
import os
import time
import uuid
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.errors import QuadtreeLssError

FORMULA = tuple("=+-@\t\r")
"""First characters of formulas in spreadsheets."""


class ReplayError(QuadtreeLssError):
    """The bag yields no map, or the results cannot be written."""


@contextmanager
def writing(out: str | Path, kind: type[QuadtreeLssError]) -> Iterator[None]:
    """Context that converts an `OSError` of writing to ``out`` to an error of type ``kind``."""
    try:
        yield
    except OSError as error:
        msg = f"{error.filename or out}: cannot be written: {error.strerror or error}"
        raise kind(msg) from None


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically; create its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        temporary.write_bytes(content)
        temporary.replace(path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename = str(path)
        raise


def write_json(path: Path, content: Any) -> None:
    text = json.dumps(plain(content), indent=2, allow_nan=False)
    write_bytes(path, (text + "\n").encode())


def plain(value: Any) -> Any:
    """Convert a value to JSON types; named tuples become objects, non-finite numbers None."""
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def write_csv(path: Path, header: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([_cell(value) for value in row] for row in rows)
    write_bytes(path, text.getvalue().encode())


def _cell(value: Any) -> Any:
    """Prefix a text that a spreadsheet would read as a formula with an apostrophe."""
    if not isinstance(value, str) or not value.startswith(FORMULA):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)  # type: ignore[arg-type]
    write_bytes(path, content.getvalue())


def new_folder(root: Path) -> Path:
    """Create a new folder ``root/<date>_<time>``."""
    name = time.strftime("%Y-%m-%d_%H-%M-%S")
    for suffix in ("", *(f"_{n}" for n in range(2, 1000))):
        with suppress(FileExistsError):
            (root / f"{name}{suffix}").mkdir(parents=True)
            return root / f"{name}{suffix}"
    raise OSError(f"{root}: too many results of one second")


@contextmanager
def made(folder: Path, kind: type[QuadtreeLssError]) -> Iterator[None]:
    """Context that creates a folder, and removes it after an error if it is empty. ``kind``: as of
    `writing`."""
    with writing(folder, kind):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        with suppress(OSError):  # not empty
            folder.rmdir()
        raise


@contextmanager
def locked(folder: Path, kind: type[QuadtreeLssError]) -> Iterator[None]:
    """Context as `made` that also locks the folder against other writers. The folder itself is
    locked, because a lock file could be a link to another file."""
    with made(folder, kind):
        with writing(folder, kind):
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise kind(f"{folder}: another program is writing to it") from None
            except OSError:  # a file system without locks
                pass
            yield
        finally:
            os.close(handle)


def link_latest(folder: Path) -> Path | None:
    """Link ``latest`` beside ``folder`` to it; return the link, None if that is impossible."""
    link = folder.parent / "latest"
    if link.exists() and not link.is_symlink():
        return None
    temporary = folder.parent / f".latest.{os.getpid()}"
    try:
        temporary.symlink_to(folder.name, target_is_directory=True)
        os.replace(temporary, link)
    except OSError:  # a file system without links
        temporary.unlink(missing_ok=True)
        return None
    return link
