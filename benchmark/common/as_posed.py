# SPDX-License-Identifier: Apache-2.0
"""Maps of which a part is left out, to see what it does."""

import contextlib
import dataclasses
from collections.abc import Iterator
from unittest import mock

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.vehicle import Lengths, VehicleConfig
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.mapping.update import ScanUpdate


class AsPosed(Mapper):
    """Scan and map are not brought to one height."""

    def _align(self, change: ScanUpdate, cells: Array, now: float) -> float:
        return 0.0


@contextlib.contextmanager
def lengths(**own: float) -> Iterator[None]:
    """Of the default vehicle, with some of one's own, while a configuration and a mapper are made:
    ``outlier_gate`` 0 keeps every return, an infinite ``feature_height`` finds no feature."""
    with mock.patch.object(VehicleConfig, "lengths", dataclasses.replace(Lengths(), **own)):
        yield
