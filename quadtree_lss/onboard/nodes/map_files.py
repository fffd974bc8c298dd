# SPDX-License-Identifier: Apache-2.0
"""Maps on disk: a mapper's state to a file and back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.tree.checkpoint import CheckpointError, check, from_bytes, to_bytes
from quadtree_lss.onboard.core.tree.leaves import LEAF
from quadtree_lss.onboard.nodes.files import MapFileError, read_file, write_atomically

OVERHEAD = 1_000_000
"""Of an archive, in bytes, over the leaves and the mask of what was observed."""


class WrongContentError(MapFileError):
    """It can be read, but what is in it is no map, or not one of this domain."""


def save(path: Path, mapper: Mapper, root: str = "") -> None:
    """Write the mapper's state. Raises `MapFileError`: see `writer`."""
    writer(path, mapper, root)()


def writer(path: Path, mapper: Mapper, root: str = "", previous: str = "") -> Callable[[], None]:
    """What replaces the file by the mapper's present state, to be called beside its own work.

    The state is read back from the disk first, and must be one that a mapper can go on from.
    ``path``, ``root``, ``previous``: as of `write_atomically`. ``mapper``: its state is copied now.
    Raises `MapFileError`: (when called) not writable, or no state to go on from; the old file is
    then untouched.
    """
    state, domain, cells = mapper.export_state(), mapper.domain, mapper.config.mapping.max_cells

    def write() -> None:
        content = to_bytes(state)
        try:
            write_atomically(path, content, root=root, verify=verify, previous=previous)
        except CheckpointError as error:
            msg = f"{path}: not written, for what would be in it {error}"
            raise MapFileError(msg) from None

    def verify(found: bytes) -> None:
        check(from_bytes(found), state, domain, cells)

    return write


def load(path: Path, mapper: Mapper, root: str = "") -> None:
    """Put the mapper into the state in a file.

    Raises:
        MapFileError: not readable; the mapper is then unchanged.
        WrongContentError: damaged, of another domain; the mapper is then unchanged.
    """
    most = mapper.config.mapping.max_cells * LEAF.itemsize + 4**mapper.domain.max_level + OVERHEAD
    content = read_file(path, root, most + 1)
    if len(content) > most:
        msg = f"{path}: is larger than any map of this configuration, {most} bytes"
        raise WrongContentError(msg)
    try:
        mapper.import_state(from_bytes(content))
    except CheckpointError as error:
        msg = f"{path}: {error}"
        raise WrongContentError(msg) from None
