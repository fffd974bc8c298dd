# SPDX-License-Identifier: Apache-2.0
"""The services of ``mapping_node``: ``~/reset``, ``~/save_map``, ``~/load_map``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rclpy.node import Node
from std_srvs.srv import Trigger

from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.nodes.files import MapFileError
from quadtree_lss.onboard.nodes.map_files import load, save


class MapServices:
    """Answers with ``success`` and one line; a failure leaves the map as it was.

    Args:
        node: Owner.
        mapper: Whose map it is.
        path, root: Parameters ``map_file.path`` and ``files.root``.
        changed: Called after a map was loaded.
        reset: Called after the map was emptied.
    """

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
