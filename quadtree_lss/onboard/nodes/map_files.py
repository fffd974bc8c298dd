# SPDX-License-Identifier: Apache-2.0
"""Maps on disk, and the services of ``mapping_node`` that keep, take up and empty its map."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rclpy.node import Node
from std_srvs.srv import Trigger

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


def writer(path: Path, mapper: Mapper, root: str = "", **how: Any) -> Callable[[], None]:
    """What replaces the file by the mapper's present state, to be called beside its own work.

    The state is read back from the disk first, and must be one that a mapper can go on from.
    ``path``, ``root``: as of `write_atomically`. ``mapper``: its state is copied now. ``how``:
    further arguments of `write_atomically`. Raises `MapFileError`: (when called) not writable, or
    no state to go on from; the old file is then untouched.
    """
    state, domain, cells = mapper.export_state(), mapper.domain, mapper.config.mapping.max_cells

    def write() -> None:
        content = to_bytes(state)
        try:
            write_atomically(path, content, root=root, verify=verify, **how)
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


class MapServices:
    """Answers with ``success`` and one line; a failure leaves the map as it was. ``path`` and
    ``root`` are ``map_file.path`` and ``files.root``; ``changed`` is called after a map was loaded,
    ``reset`` after it was emptied."""

    def __init__(
        self,
        node: Node,
        mapper: Mapper,
        *,
        path: str,
        root: str,
        changed: Callable[[], None],
        reset: Callable[[], None],
    ) -> None:
        self._logger = node.get_logger()
        self._mapper = mapper
        self._path, self._root = path, root
        self._on_change, self._on_reset = changed, reset
        for name, work in (
            ("reset", self._reset),
            ("save_map", self._save),
            ("load_map", self._load),
        ):
            node.create_service(Trigger, f"~/{name}", self._answering(work))

    def _reset(self) -> str:
        self._mapper.reset()
        self._on_reset()
        return "map emptied"

    def _save(self) -> str:
        path = self._file()
        save(path, self._mapper, self._root)
        return f"{self._mapper.leaves.count} leaves saved to {path}"

    def _load(self) -> str:
        path = self._file()
        load(path, self._mapper, self._root)
        self._on_change()
        return f"{self._mapper.leaves.count} leaves loaded from {path}"

    def _file(self) -> Path:
        if not self._path:
            msg = "parameter map_file.path is not set"
            raise MapFileError(msg)
        return Path(self._root, self._path).absolute()

    def _answering(
        self, work: Callable[[], str]
    ) -> Callable[[Trigger.Request, Trigger.Response], Trigger.Response]:
        def serve(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                response.message, response.success = work(), True
                self._logger.info(response.message)
            except MapFileError as error:
                response.message, response.success = str(error), False
                self._logger.warning(response.message)
            return response

        return serve
